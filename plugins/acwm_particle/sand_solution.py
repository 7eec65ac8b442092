"""Where push_sand's sand is to go, and strokes that push it there."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from acwm_particle.sand import Sand
from acwm_particle.sand_policy import ABOVE, Raker, heading

_OFF = (0.14, 0.22)
"""Metres from the middle of the sand to that of the region."""

_ROOM = np.array([0.40, 0.22])
"""Half width and depth in metres in which the region's middle lies."""

_STROKES = 12
"""Strokes that are considered before one is made."""

_RUN_UP = 0.05
"""Metres before the sand at which the board is lowered."""


def draw_region(sand: Sand, radius: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """A region beside the middle of the sand: x, y and radius, metres."""
    middle = sand.grains[:, :2].mean(0, dtype=np.float64)
    while True:
        angle, off = rng.uniform(-np.pi, np.pi), rng.uniform(*_OFF)
        place = middle + off * np.array([np.cos(angle), np.sin(angle)])
        if (np.abs(place) <= _ROOM).all():
            return np.array([*place, radius])


class Gatherer(Raker):
    """Pushes sand into a region, stroke by stroke, each where it takes most of it along.

    Args:
        sand: sand and board; changed through actions alone.
        region: x, y and radius, metres.
        rng: draws the strokes that are considered.
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
        """A stroke from outside of the sand towards the region, to its rim on this side."""
        place, radius = self._region[:2], self._region[2]
        angle = self.rng.uniform(-np.pi, np.pi)
        back = np.array([np.cos(angle), np.sin(angle)])
        aside = self.rng.uniform(-0.6, 0.6) * radius * np.array([-back[1], back[0]])
        flat = self.sand.grains[:, :2] - place - aside
        near = np.abs(flat @ [-back[1], back[0]]) < self.sand.half[1]
        far = float((flat[near] @ back).max(initial=radius)) + _RUN_UP
        return place + aside + far * back, place + aside + 0.35 * radius * back

    def _worth(self, stroke: tuple[NDArray[np.float64], NDArray[np.float64]]) -> float:
        """Grains outside of the region that are in its way, per metre of all ways."""
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
