"""The camera and the light of a scene."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Vec3 = tuple[float, float, float]


def linear(color: Vec3 | NDArray[np.floating]) -> NDArray[np.float32]:
    """Convert a display colour (gamma 2.2, 0 to 1) to linear light, used for all shading."""
    return np.asarray(color, np.float32) ** np.float32(2.2)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera, independent of the frame size.

    Frame coordinates are measured from the middle of the frame, x to the right and y down, in units
    of the frame height.

    Attributes:
        eye: position in metres, world frame (z up).
        target: the point in the centre of the frame.
        up: direction that points up in the frame; must not be parallel to the viewing direction.
        fov: vertical angle of view in degrees. A wider frame sees more to the sides.
    """

    eye: Vec3
    target: Vec3 = (0.0, 0.0, 0.0)
    up: Vec3 = (0.0, 0.0, 1.0)
    fov: float = 45.0

    @cached_property
    def axes(self) -> NDArray[np.float64]:
        """[3, 3]; its rows are the camera's right, down and forward directions in the world."""
        forward = _unit(np.subtract(self.target, self.eye).astype(np.float64))
        right = _unit(np.cross(forward, self.up))
        return np.stack([right, np.cross(forward, right), forward])

    @property
    def rotation(self) -> NDArray[np.float32]:
        """[3, 3]; its rows are the camera's right, up and forward directions in the world."""
        return (self.axes * [[1.0], [-1.0], [1.0]]).astype(np.float32)

    def focal(self, height: int = 1) -> float:
        """Focal length in pixels for a frame of this height; in frame heights for `height` 1."""
        return height * 0.5 / math.tan(math.radians(self.fov) / 2)

    def to_frame(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert world points [..., 3] to frame coordinates x, y and depth in metres [..., 3]."""
        local = (np.asarray(points, np.float64) - np.asarray(self.eye)) @ self.axes.T
        depth = local[..., 2:]
        return np.concatenate([self.focal() * local[..., :2] / depth, depth], axis=-1)

    def from_frame(self, seen: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert frame coordinates and depth [..., 3] to world points; inverse of `to_frame`."""
        depth = seen[..., 2:]
        local = np.concatenate([seen[..., :2] * depth / self.focal(), depth], axis=-1)
        return local @ self.axes + np.asarray(self.eye)

    def on_plane(self, seen: NDArray[np.float64], height: float) -> NDArray[np.float64]:
        """Where rays through frame coordinates [..., 2] meet the plane z = `height`: [..., 3]."""
        ray = np.concatenate([seen / self.focal(), np.ones_like(seen[..., :1])], axis=-1)
        direction = ray @ self.axes
        reach = (height - self.eye[2]) / direction[..., 2:]
        return np.asarray(self.eye) + reach * direction

    def project(self, points: NDArray[np.floating], height: int, width: int) -> NDArray[np.float32]:
        """Convert world points [..., 3] to pixel x (right), pixel y (down) and depth in metres.

        The centre of the pixel in row i and column j is at (j + 0.5, i + 0.5).
        """
        local = (np.asarray(points) - np.asarray(self.eye)) @ self.rotation.T
        scale = self.focal(height) / local[..., 2]
        x, y = width * 0.5 + scale * local[..., 0], height * 0.5 - scale * local[..., 1]
        return np.stack([x, y, local[..., 2]], axis=-1).astype(np.float32)


@dataclass(frozen=True)
class Light:
    """A sun that casts soft shadows, and uniform ambient light that casts none.

    Attributes:
        direction: direction towards the sun, of any length.
        sun: linear colour of sunlight on a surface that faces it.
        sky: linear colour of the ambient light from above.
        bounce: linear colour of the ambient light from below.
        softness: half width in metres of the blur at a shadow's edge.
        background: display colour where nothing is drawn.
    """

    direction: Vec3 = (0.35, -0.45, 1.2)
    sun: Vec3 = (0.78, 0.76, 0.72)
    sky: Vec3 = (0.33, 0.35, 0.40)
    bounce: Vec3 = (0.20, 0.19, 0.18)
    softness: float = 0.006
    background: Vec3 = (0.62, 0.70, 0.80)

    @property
    def basis(self) -> NDArray[np.float32]:
        """[3, 3]; rows: two directions perpendicular to the light, and the light's direction."""
        towards = _unit(np.asarray(self.direction, np.float64))
        side = (0.0, 1.0, 0.0) if abs(towards[1]) < 0.9 else (1.0, 0.0, 0.0)
        across = _unit(np.cross(side, towards))
        return np.stack([across, np.cross(towards, across), -towards]).astype(np.float32)
