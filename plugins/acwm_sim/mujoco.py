"""MuJoCo without OpenGL, for which it would look on import; frames come from `acwm_sim.scene`.

A program that also draws with MuJoCo itself imports ``mujoco`` before this.
"""

from typing import Any

from acwm_sim.shell import undisturbed

with undisturbed("MUJOCO_GL", MUJOCO_GL="disabled"):
    import mujoco as _mujoco

__all__ = ["mujoco"]

mujoco: Any = _mujoco
"""The module ``mujoco``."""
