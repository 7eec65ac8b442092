"""What Taichi compiles from its source; Python's types do not apply, so pyright leaves it out."""
