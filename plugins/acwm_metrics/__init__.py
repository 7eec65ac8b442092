"""Metrics of predicted video."""
