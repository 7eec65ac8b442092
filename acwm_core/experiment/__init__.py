"""Experiments: many runs that make one table, from simulation to report. Imports no torch."""

ENDS_WITH_INPUT = "ACWM_ENDS_WITH_INPUT"
"""Set in the environment of a step on this machine: it ends as soon as its standard input does."""
