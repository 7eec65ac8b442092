"""Ranking policies in a world model: scripted ones, users' own, and how far the truth agrees."""
