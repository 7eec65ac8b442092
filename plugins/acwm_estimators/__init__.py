"""Reads states from frames with a small network per environment; the weights are included."""
