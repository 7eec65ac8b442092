"""Writes one prediction of a trained model as a video."""
