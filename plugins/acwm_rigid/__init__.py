"""Environments of rigid bodies: cubes pushed on a table."""
