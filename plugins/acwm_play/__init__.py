"""A page to play in a world: simulator and model side by side, with the same actions."""
