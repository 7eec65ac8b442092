"""Executors for clusters: tasks on Ray, and tasks and jobs in SLURM."""
