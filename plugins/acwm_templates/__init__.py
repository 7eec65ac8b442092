"""`acwm new`: template packages for your own components."""
