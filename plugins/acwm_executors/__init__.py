"""Executors for clusters: tasks on Ray, and tasks and jobs on SLURM."""
