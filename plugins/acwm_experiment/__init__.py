"""Experiments: many runs that make one table, from simulation to report. Imports no torch."""
