"""A camera that is fitted to where things appear, for worlds that declare none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FittedCamera:
    """A projection of the world into the frame, used like `acwm_core.env.camera.Camera`.

    Attributes:
        matrix: rows of the 3 × 4 matrix that takes (x, y, z, 1) to (u·w, v·w, w), where u points
            right and v down from the frame's centre in frame heights.
        constant: the coordinates that never change, by axis.
    """

    matrix: tuple[tuple[float, ...], ...]
    constant: tuple[tuple[int, float], ...] = ()

    def to_frame(self, points: Array) -> Array:
        """Points `[…, 3]` to u, v and w `[…, 3]`."""
        seen = with_ones(points) @ np.array(self.matrix).T
        return np.concatenate([seen[..., :2] / seen[..., 2:], seen[..., 2:]], -1)

    def from_frame(self, seen: Array) -> Array:
        """The inverse of `to_frame`."""
        matrix = np.array(self.matrix)
        scaled = np.concatenate([seen[..., :2] * seen[..., 2:], seen[..., 2:]], -1)
        found = (scaled - matrix[:, 3]) @ np.linalg.pinv(matrix[:, :3]).T
        for axis, value in self.constant:
            found[..., axis] = value
        return found

    def on_plane(self, seen: Array, height: float) -> Array:
        """Where rays through u, v `[…, 2]` meet the plane z = `height`: `[…, 3]`."""
        matrix = np.array(self.matrix)
        flat = np.column_stack([matrix[:, :2], matrix[:, 2] * height + matrix[:, 3]])
        found = with_ones(seen) @ np.linalg.inv(flat).T
        ground = found[..., :2] / found[..., 2:]
        return np.concatenate([ground, np.full_like(ground[..., :1], height)], -1)


def with_ones(points: Array) -> Array:
    """Points `[…, D]` with a last coordinate of one."""
    return np.concatenate([points, np.ones_like(points[..., :1])], -1)
