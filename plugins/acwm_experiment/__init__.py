"""Experiments: many runs that form one table, from simulation to report. Does not import torch."""
