"""The pinhole camera through which an environment is seen, from points to frames and back."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Pinhole:
    """The camera of an environment's nominal factors, independent of the size of the frame.

    Frame coordinates are x to the right and y down, both in heights of the frame, from its middle.

    Attributes:
        eye: position in metres, world frame (z up).
        target: the point that lands in the middle of the frame.
        fov: vertical angle of view in degrees.
        up: direction that points up in the frame.
    """

    eye: Point
    target: Point
    fov: float
    up: Point = (0.0, 0.0, 1.0)

    @cached_property
    def rotation(self) -> Array:
        """`[3, 3]`; its rows are the camera's right, down and forward directions."""
        forward = np.subtract(self.target, self.eye)
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, self.up)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    @property
    def focal(self) -> float:
        """Focal length in heights of the frame."""
        return 0.5 / float(np.tan(np.radians(self.fov) / 2))

    def project(self, points: Array) -> Array:
        """World points `[…, 3]` to `[…, 3]`: frame coordinates x, y, and depth in metres."""
        local = (np.asarray(points, np.float64) - np.asarray(self.eye)) @ self.rotation.T
        depth = local[..., 2:]
        return np.concatenate([self.focal * local[..., :2] / depth, depth], axis=-1)

    def unproject(self, seen: Array) -> Array:
        """The inverse of `project`."""
        depth = seen[..., 2:]
        local = np.concatenate([seen[..., :2] * depth / self.focal, depth], axis=-1)
        return local @ self.rotation + np.asarray(self.eye)

    def on_plane(self, seen: Array, height: float) -> Array:
        """Where rays through frame coordinates `[…, 2]` meet the plane z = `height`: `[…, 3]`."""
        ray = np.concatenate([seen / self.focal, np.ones_like(seen[..., :1])], axis=-1)
        direction = ray @ self.rotation
        reach = (height - self.eye[2]) / direction[..., 2:]
        return np.asarray(self.eye) + reach * direction
