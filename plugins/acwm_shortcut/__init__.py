"""Shortcut forcing: an objective whose models sample in few steps."""
