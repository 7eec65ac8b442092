"""Policies trained in a model, by `acwm policy train`, and evaluated in the simulator."""
