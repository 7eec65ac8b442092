"""`acwm new`: packages to begin a component of one's own with."""
