"""Reads states from frames: a small network for every environment, with its weights."""
