"""The cart-pole of dm_control for acwm."""
