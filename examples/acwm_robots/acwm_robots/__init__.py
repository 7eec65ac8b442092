"""Robots of other packages for acwm: their simulators and pictures as they are."""

import os
import sys

if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # read when MuJoCo's renderer is imported
