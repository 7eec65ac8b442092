"""Sand and water, simulated with position-based dynamics in Taichi."""
