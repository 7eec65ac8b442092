"""Planning with a world model: tasks, and planners that choose actions to solve them."""
