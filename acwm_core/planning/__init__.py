"""What a world model is for: tasks, and what chooses actions to solve them."""
