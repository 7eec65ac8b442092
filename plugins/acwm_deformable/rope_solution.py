"""A script that pushes the rope into a shape, by trying pushes on copies of the rope."""

from collections.abc import Generator, Iterator

import numpy as np
from numpy.typing import NDArray

from acwm_deformable.rope import Rope
from acwm_deformable.rope_paths import ClearanceGrid
from acwm_deformable.rope_policy import Point, Pusher, ahead_of

_CANDIDATES = 32
"""Number of pushes that are tried before one is executed."""

_GAIN = 0.004
"""Least improvement of the mean distance by a push in metres."""


class Shaper(Pusher):
    """Moves the pole so that the rope takes a given shape.

    Args:
        rope: the simulation, which it observes.
        most: largest step of the pole along an axis in a frame, metres.
        wanted: `[N, 2]`, wanted nodes of the rope in metres, starting at either end.
        rng: source of all its randomness.
    """

    def __init__(
        self, rope: Rope, most: float, wanted: NDArray[np.floating], rng: np.random.Generator
    ) -> None:
        wanted = np.asarray(wanted, np.float64)
        turned = min((wanted, wanted[::-1]), key=lambda w: np.linalg.norm(w - rope.nodes))
        self._wanted = turned
        super().__init__(rope, most, rng)

    def _live(self) -> Iterator[Point]:
        self.speed = 0.7 * self.most
        while True:
            yield from self._best_push()

    def _best_push(self) -> Generator[Point]:
        """Execute the push that brings the rope nearest; wait a frame if none helps."""
        chart = ClearanceGrid(self.rope.nodes, self.place, self._contact)
        best, plan = self._error(self.rope) - _GAIN, None
        for _ in range(_CANDIDATES):
            start, heading = self._aim()
            if not np.isfinite(chart.cost(start)):
                continue
            error, steps = self._try(start, heading)
            error += 0.01 * chart.cost(start)
            if error < best:
                best, plan = error, (start, heading, steps)
        if plan is None:
            yield self.target
            return
        start, heading, steps = plan
        for corner in chart.way(start):
            yield from self._straight(corner, 0.98 * self.most)
        for _ in range(steps):
            yield self.target + self.speed * ahead_of(heading)
        yield from self._straight(self.target - 0.05 * ahead_of(heading), self.speed)

    def _aim(self) -> tuple[Point, float]:
        """Start and heading of a push that moves a node, likely a distant one, to its place."""
        nodes = self.rope.nodes.astype(np.float64)
        gaps = self._wanted - nodes
        far = np.linalg.norm(gaps, axis=1)
        node = int(self.rng.choice(len(far), p=far**2 / (far**2).sum()))
        heading = np.arctan2(gaps[node, 1], gaps[node, 0]) + self.rng.normal(0, 0.4)
        return nodes[node] - ahead_of(heading) * (self._contact + 0.01), float(heading)

    def _try(self, start: Point, heading: float) -> tuple[float, int]:
        """The smallest error during a push, and the number of steps until then."""
        copy = Rope(self.rope.cord, self.rope.nodes, start)
        errors, step = list[float](), self.speed * ahead_of(heading)
        while len(errors) < 4 or (len(errors) < 25 and errors[-1] <= min(errors) + _GAIN):
            copy.advance(step)
            errors.append(self._error(copy))
        best = int(np.argmin(errors))
        return errors[best], best + 1

    def _error(self, rope: Rope) -> float:
        return float(np.linalg.norm(rope.nodes - self._wanted, axis=1).mean())
