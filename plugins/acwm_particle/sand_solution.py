"""The goal region for push_sand's sand, and strokes that push the sand there."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from acwm_particle.sand import Sand
from acwm_particle.sand_policy import ABOVE, Raker, heading

_OFF = (0.14, 0.22)
"""Range of distances in metres from the middle of the sand to the centre of the region."""

_ROOM = np.array([0.40, 0.22])
"""Half width and half depth in metres of the area for the region's centre."""

_STROKES = 12
"""Number of strokes that are considered before one is made."""

_RUN_UP = 0.05
"""Distance in metres in front of the sand at which the board is lowered."""


def draw_region(sand: Sand, radius: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a region beside the middle of the sand: x, y and radius in metres."""
    middle = sand.grains[:, :2].mean(0, dtype=np.float64)
    while True:
        angle, off = rng.uniform(-np.pi, np.pi), rng.uniform(*_OFF)
        place = middle + off * np.array([np.cos(angle), np.sin(angle)])
        if (np.abs(place) <= _ROOM).all():
            return np.array([*place, radius])


class Gatherer(Raker):
    """Pushes sand into a region with strokes, each chosen to move the most sand.

    Args:
        sand: sand and board, changed only through actions.
        region: x, y and radius, metres.
        rng: draws the strokes to choose from.
    """

    def __init__(self, sand: Sand, region: NDArray[np.float64], rng: np.random.Generator) -> None:
        self._region = np.asarray(region, np.float64)
        super().__init__(sand, rng)

    def _play(self) -> Iterator[NDArray[np.float64]]:
        while True:
            start, end = max((self._draw() for _ in range(_STROKES)), key=self._worth)
            yaw = self._nearest_face(np.arctan2(*(end - start)[::-1]))
            high = [*self.sand.board.position[:2], ABOVE]
            yield from self._go(high, heading(yaw), both=False)
            yield from self._go([*start, ABOVE], heading(yaw))
            yield from self._go([*start, self._low], heading(yaw))
            yield from self._go([*end, self._low], heading(yaw))

    def _draw(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Draw a stroke that starts outside the sand and ends in the near part of the region."""
        place, radius = self._region[:2], self._region[2]
        angle = self.rng.uniform(-np.pi, np.pi)
        back = np.array([np.cos(angle), np.sin(angle)])
        aside = self.rng.uniform(-0.6, 0.6) * radius * np.array([-back[1], back[0]])
        flat = self.sand.grains[:, :2] - place - aside
        near = np.abs(flat @ [-back[1], back[0]]) < self.sand.half[1]
        far = float((flat[near] @ back).max(initial=radius)) + _RUN_UP
        return place + aside + far * back, place + aside + 0.35 * radius * back

    def _worth(self, stroke: tuple[NDArray[np.float64], NDArray[np.float64]]) -> float:
        """Number of grains outside the region that a stroke moves, per metre of travel."""
        start, end = stroke
        way = end - start
        length = float(np.linalg.norm(way))
        ahead = way / length
        flat = self.sand.grains[:, :2] - start
        along, side = flat @ ahead, flat @ [-ahead[1], ahead[0]]
        outside = np.linalg.norm(self.sand.grains[:, :2] - self._region[:2], axis=1)
        taken = (along > 0) & (along < length) & (np.abs(side) < self.sand.half[1])
        walk = float(np.linalg.norm(self.sand.board.position[:2] - start))
        return float((taken & (outside > self._region[2])).sum()) / (0.3 + length + walk)
