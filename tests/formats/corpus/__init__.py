"""Small recordings with one property each and a known right answer, made without acwm."""
