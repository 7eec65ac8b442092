"""Environments of rigid bodies: cubes pushed on a table, cubes stacked by a robot."""
