"""Quaternions and rotation matrices."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def rotations(quaternions: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices [N, 3, 3] of unit quaternions [N, 4], (x, y, z, w)."""
    x, y, z, w = np.asarray(quaternions, np.float64).T
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
