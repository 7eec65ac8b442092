"""Code that Taichi compiles. Python's types do not apply to it, so pyright skips it."""
