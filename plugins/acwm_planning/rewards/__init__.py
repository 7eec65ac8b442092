"""Rewards that are learnt from a recorded column: heads, and what uses them."""

HEAD_FILE = "reward.safetensors"
"""The file in a head's folder."""
