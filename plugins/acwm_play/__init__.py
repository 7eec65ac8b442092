"""A world to play in: the simulator and the model side by side, under the same actions."""
