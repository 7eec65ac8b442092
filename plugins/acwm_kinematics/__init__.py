"""Articulated arms: a Franka Panda in PyBullet, a two-link reacher in MuJoCo."""
