"""A damped pendulum driven by a torque: an environment and a metric for acwm."""
