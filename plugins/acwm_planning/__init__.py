"""Planning with world models: planners, costs, and model-predictive control in the simulator."""
