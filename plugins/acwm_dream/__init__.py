"""A Gymnasium environment made of a world model: `gymnasium.make("acwm/dream-v0", run=…)`."""
