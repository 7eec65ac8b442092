"""A Gymnasium environment made from a world model: `gymnasium.make("acwm/dream-v0", run=…)`."""
