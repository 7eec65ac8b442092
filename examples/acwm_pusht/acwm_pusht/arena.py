"""gym-pusht's simulator: its physics and its picture as they are, with a T of any size."""

import os
from typing import Any, cast

import numpy as np
import pymunk
from numpy.typing import NDArray
from PIL import Image

os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # pygame greets on standard output

import pygame
from gym_pusht.envs import PushTEnv

SIDE = 512
"""Side of the arena in pixels of gym-pusht, its unit of length."""

RADIUS = 15
"""Radius of the agent."""

_COLOURS = ("White", "LightGray", "LightGreen", "LightSlateGray", "RoyalBlue")
"""What gym-pusht draws each instance with; insides are a fifth lighter."""


class Arena(PushTEnv):
    """Push-T with a T of bars that are `scale` wide, and with who touches whom.

    Args:
        scale: width of the T's bars in px; gym-pusht's is 30.
        damping: share of its speed that the pushed T keeps after a second; gym-pusht's is 0.
    """

    def __init__(self, scale: float, damping: float) -> None:
        self._scale = scale
        self.touching: set[tuple[int, int]] = set()
        super().__init__(obs_type="state", damping=damping)

    def add_tee(self, space: Any, position: Any, angle: Any) -> Any:  # pyright: ignore
        """As gym-pusht's, which has one size."""
        return PushTEnv.add_tee(space, position, angle, scale=cast(int, self._scale))

    def start(self, state: NDArray[np.float64]) -> bool:
        """Begin anew: agent x, y, T x, y and angle; whether the two are apart."""
        self.touching.clear()
        self.reset(options={"reset_to_state": state})
        return self.gap(np.array(state[:2])) > RADIUS

    def move(self, target: NDArray[np.float64]) -> None:
        """Pull the agent towards a point for one frame, a tenth of a second."""
        self.touching.clear()
        self.step(target)

    def place(self, position: tuple[float, float], angle: float) -> None:
        """Put the T somewhere, at rest."""
        self.block.angle, self.block.position = angle, position  # turning moves the T
        self.block.velocity, self.block.angular_velocity = (0, 0), 0
        self.space.reindex_shapes_for_body(self.block)

    def gap(self, point: NDArray[np.float64]) -> float:
        """Distance of a point from the T."""
        return min(shape.point_query(point.tolist()).distance for shape in self._block_shapes)

    def corners(self) -> NDArray[np.float64]:
        """The corners of the T's two bars, `[8, 2]`."""
        return self.get_keypoints(self._block_shapes)

    def picture(self, size: tuple[int, int]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The frame `[H, W, 3]`, averaged over the area of each pixel, and its mask `[H, W]`."""
        drawn = pygame.image.tobytes(self._draw(), "RGB")
        frame = Image.frombytes("RGB", (SIDE, SIDE), drawn)
        small = np.asarray(frame.resize((size[1], size[0]), Image.Resampling.BOX))
        rows, columns = (((np.arange(n) + 0.5) * SIDE / n).astype(int) for n in size)
        centres = np.frombuffer(drawn, np.uint8).reshape(SIDE, SIDE, 3)[rows][:, columns]
        return small, _instances(centres)

    def _handle_collision(self, arbiter: Any, space: Any, data: Any) -> None:
        super()._handle_collision(arbiter, space, data)
        first, second = sorted(map(self._instance, arbiter.shapes))
        self.touching.add((first, second))

    def _instance(self, shape: pymunk.Shape) -> int:
        return 3 if shape.body is self.block else 4 if shape.body is self.agent else 1


_PURE = np.array([pygame.Color(name)[:3] for name in _COLOURS], float)
_LIGHT = np.minimum(1.2 * _PURE[3:], 255)


def _instances(seen: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The instance whose colour each pixel `[H, W, 3]` has, within rounding."""
    numbers = seen.astype(int) @ np.array([65536, 256, 1])
    numbers, places = np.unique(numbers, return_inverse=True)
    colours = np.stack([numbers >> 16, numbers >> 8 & 255, numbers & 255], -1)
    known = np.vstack([_PURE, _LIGHT])
    nearest = np.abs(colours[:, None] - known).sum(-1).argmin(-1)
    return np.array([0, 1, 2, 3, 4, 3, 4], np.uint8)[nearest][places].reshape(seen.shape[:2])
