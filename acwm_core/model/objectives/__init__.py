"""Objectives: how a model learns from clips, and how it predicts what it has learned."""
