"""Push-T of gym-pusht as an environment for acwm."""
