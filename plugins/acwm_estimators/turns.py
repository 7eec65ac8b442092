"""Headings of bodies that stay level."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def heading(quaternion: Array) -> Array:
    """Rotation around z of quaternions `[…, 4]` (w, x, y, z), in radians."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def upright(angle: Array) -> Array:
    """Quaternions `[…, 4]` of rotations around z."""
    zero = np.zeros_like(angle)
    return np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=-1)
