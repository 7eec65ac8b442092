"""What a world on PyBullet needs, to register it with; imports no simulator."""

import platform
import sys
from typing import Any

PIN = "pybullet==3.2.7"

_HAS_WHEEL = (sys.version_info[:2], sys.platform, platform.machine()) == (
    (3, 11),
    "linux",
    "x86_64",
)

BULLET: dict[str, Any] = {
    "extra": "bullet",
    "requires": ("pybullet", "taichi"),
    "install": ""
    if _HAS_WHEEL
    else f"pip install 'acwm[bullet]' {PIN} builds it, in minutes; Python 3.11 on Linux (x86-64) "
    "has a wheel (see docs/installation.md)",
}
"""Keyword arguments of `acwm_core.plugins.Registry.add`."""
