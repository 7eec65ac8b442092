"""Ranks policies in a model, and tells how far the simulator agrees."""
