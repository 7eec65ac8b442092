"""Errors against a factor: what `acwm evaluate --sweep` simulates, scores and keeps."""
