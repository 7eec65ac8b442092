"""The camera of an environment: where in the picture something is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.arrays import Array, constant, namespace, real
from acwm_core.errors import ShapeError

Vec3 = tuple[float, float, float]


@dataclass(frozen=True)
class Camera:
    """A camera that stands still, independent of the frame size: a pinhole, or orthographic.

    Frame coordinates are measured from the middle of the frame, x to the right and y down, in units
    of the frame height.

    Attributes:
        eye: position in the world, m or the unit of the positions.
        target: the point in the middle of the frame.
        up: direction that points up in the frame; not parallel to the viewing direction.
        fov: vertical angle of view in degrees. A wider frame sees more to the sides.
        half_height: half of the height that the frame shows, for an orthographic camera; `fov` has
            no meaning then. None for a pinhole.

    Raises:
        ShapeError: the numbers are those of no camera.
    """

    eye: Vec3
    target: Vec3 = (0.0, 0.0, 0.0)
    up: Vec3 = (0.0, 0.0, 1.0)
    fov: float = 45.0
    half_height: float | None = None

    def __post_init__(self) -> None:
        for name in ("eye", "target", "up"):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != 3 or not all(map(math.isfinite, values)):
                raise ShapeError(f"a camera's {name} is three finite numbers, not {list(values)}")
        forward = np.subtract(self.target, self.eye).astype(np.float64)
        if not np.linalg.norm(np.cross(forward, self.up)) > 1e-9:
            raise ShapeError(
                "a camera's eye and target must differ, and up must not be the direction of view"
            )
        if not 0 < self.fov < 180:
            raise ShapeError(f"a camera's fov lies between 0 and 180 degrees, not {self.fov:g}")
        if self.half_height is not None and not 0 < self.half_height < math.inf:
            raise ShapeError(f"a camera's half_height is positive, not {self.half_height:g}")

    @classmethod
    def flat(
        cls, half_height: float, middle: tuple[float, float] = (0.0, 0.0), *, down: bool = False
    ) -> Camera:
        """The camera of a world in the plane of the picture, with x to the right.

        Args:
            half_height: half of the height that the frame shows.
            middle: the place in the middle of the frame.
            down: whether y points down in the frame, as rows of pixels do, and not up.
        """
        x, y = middle
        side = -1.0 if down else 1.0
        return cls((x, y, side), (x, y, 0.0), (0.0, side, 0.0), half_height=half_height)

    @cached_property
    def axes(self) -> NDArray[np.float64]:
        """[3, 3]; its rows are the camera's right, down and forward directions in the world."""
        forward = _unit(np.subtract(self.target, self.eye).astype(np.float64))
        right = _unit(np.cross(forward, self.up))
        return np.stack([right, np.cross(forward, right), forward])

    @property
    def is_flat(self) -> bool:
        """Whether it is orthographic: what is far away is not smaller."""
        return self.half_height is not None

    @property
    def scale(self) -> float:
        """Frame coordinates per metre; of a pinhole at a depth of 1 m, and less in proportion."""
        return self.focal() if self.half_height is None else 0.5 / self.half_height

    @property
    def half_extent(self) -> float:
        """Half of the height that the frame shows, m; of a pinhole as far away as its target."""
        if self.half_height is not None:
            return self.half_height
        return math.dist(self.eye, self.target) * math.tan(math.radians(self.fov) / 2)

    def focal(self, height: int = 1) -> float:
        """Focal length in pixels for a frame of this height; in frame heights for `height` 1.

        Raises:
            ShapeError: the camera is orthographic.
        """
        if self.half_height is not None:
            raise ShapeError("an orthographic camera has no focal length")
        return height * 0.5 / math.tan(math.radians(self.fov) / 2)

    def to_frame(self, points: Array) -> Array:
        """Convert world points [..., 3] to frame coordinates x, y and depth in metres [..., 3]."""
        given = real(points)
        # Not a matrix product, which mixed precision would round.
        along = (given - constant(self.eye, given))[..., None, :] * constant(self.axes, given)
        local = along.sum(-1)
        seen, depth = local[..., :2], local[..., 2:]
        seen = seen * self.scale if self.is_flat else seen * self.scale / depth
        return namespace(given).concatenate([seen, depth], -1)

    def from_frame(self, seen: Array) -> Array:
        """Convert frame coordinates and depth [..., 3] to world points; inverse of `to_frame`."""
        given = real(seen)
        spots, depth = given[..., :2], given[..., 2:]
        spots = spots / self.scale if self.is_flat else spots * depth / self.scale
        local = namespace(given).concatenate([spots, depth], -1)
        in_world = (local[..., None, :] * constant(self.axes.T, given)).sum(-1)
        return in_world + constant(self.eye, given)

    def on_plane(self, seen: Array, height: float) -> Array:
        """Where rays through frame coordinates [..., 2] meet the plane z = `height`: [..., 3]."""
        spots = real(seen)[..., :2]
        ones = namespace(spots).ones_like(spots[..., :1])
        near, far = (
            self.from_frame(namespace(spots).concatenate([spots, depth * ones], -1))
            for depth in (0.0, 1.0)
        )
        ray = far - near
        return near + (height - near[..., 2:]) / ray[..., 2:] * ray

    def project(self, points: Array, height: int, width: int) -> Array:
        """Convert world points [..., 3] to pixel x (right), pixel y (down) and depth in metres.

        The centre of the pixel in row i and column j is at (j + 0.5, i + 0.5).
        """
        seen: Any = self.to_frame(points)
        middle = constant([width / 2, height / 2, 0], seen)
        return seen * constant([height, height, 1], seen) + middle

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Camera:
        """The inverse of `dataclasses.asdict`, also after a round trip through JSON or YAML."""
        names = [name for name in ("eye", "target", "up") if name in values]
        vectors: dict[str, Any] = {name: tuple(values[name]) for name in names}
        return cls(**{**values, **vectors})


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector)
