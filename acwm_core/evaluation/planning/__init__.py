"""Planning, as experiments and reports know it: its settings, and tasks that are planned."""
