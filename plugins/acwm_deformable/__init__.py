"""A rope and a cloth, simulated with extended position-based dynamics (XPBD) in Taichi."""
