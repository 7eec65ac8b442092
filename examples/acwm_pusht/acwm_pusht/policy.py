"""The scripted policy that collects data: it pushes the T about, and at times pulls at random."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from acwm_pusht.arena import RADIUS, SIDE, Arena

Point = NDArray[np.float64]

_HELD = 5
"""Frames for which a random pull is held."""

_MARGIN = 25
"""Distance from the rim, px, within which no push begins."""


class Pusher:
    """Goes around the T to any of its sides, and pushes somewhere into it.

    Args:
        arena: the simulator, which it observes.
        reach: the longest pull per axis, px.
        rng: source of all its randomness.
    """

    def __init__(self, arena: Arena, reach: float, rng: np.random.Generator) -> None:
        self.arena, self.reach, self.rng = arena, reach, rng
        self.strength = reach

    def pulls(self) -> Iterator[Point]:
        """Actions without end: two pushes in three, else one to three random pulls."""
        while True:
            self.strength = self.rng.uniform(0.4, 1.0) * self.reach
            start = self._beside() if self.rng.random() < 0.67 else None
            if start is None:
                yield from self._anything(int(self.rng.integers(1, 4)))
            else:
                yield from self._walk(start)
                yield from self._push()

    @property
    def _agent(self) -> Point:
        return np.array(self.arena.agent.position)

    @property
    def _middle(self) -> Point:
        return self.arena.corners().mean(0)

    @property
    def _around(self) -> float:
        """Distance from the T's middle at which the disc cannot touch it, px."""
        corners = self.arena.corners() - self._middle
        return float(np.linalg.norm(corners, axis=1).max()) + RADIUS + 5

    def _anything(self, times: int) -> Iterator[Point]:
        for _ in range(times):
            pull = self.rng.uniform(-self.reach, self.reach, 2)
            for _ in range(_HELD):
                yield pull

    def _beside(self) -> Point | None:
        """The nearest of three places on a circle around the T; None if none is in the arena."""
        angles = self.rng.uniform(0, 2 * np.pi, (3, 1))
        places = self._middle + self._around * np.hstack([np.cos(angles), np.sin(angles)])
        inside = places[((places > _MARGIN) & (places < SIDE - _MARGIN)).all(1)]
        far = np.linalg.norm(inside - self._agent, axis=1)
        return inside[far.argmin()] if len(inside) else None

    def _walk(self, goal: Point) -> Iterator[Point]:
        """Go to a place beside the T, around it where it is in the way."""
        for _ in range(30):
            here, there = self._agent - self._middle, goal - self._middle
            if np.linalg.norm(here - there) < 12:
                return
            turn = float(np.arctan2(here[0] * there[1] - here[1] * there[0], here @ there))
            step = there
            if abs(turn) > 0.5:
                angle = np.arctan2(here[1], here[0]) + np.clip(turn, -0.5, 0.5)
                step = self._around * np.array([np.cos(angle), np.sin(angle)])
            yield self._pull(step - here)

    def _push(self) -> Iterator[Point]:
        """Push towards a point of the T for a while, not quite straight."""
        shares = self.rng.dirichlet(np.ones(4))
        bar = self.arena.corners().reshape(2, 4, 2)[self.rng.integers(2)]
        way = shares @ bar - self._agent
        way *= self.strength / max(float(np.linalg.norm(way)), 1e-9)
        for _ in range(int(self.rng.integers(6, 20))):
            ahead = self._agent + 0.5 * way
            if (ahead < RADIUS).any() or (ahead > SIDE - RADIUS).any():
                return
            yield self._pull(way + self.rng.normal(0, 4, 2))

    def _pull(self, way: Point) -> Point:
        """As far as it is, and no farther than this time's strength."""
        return way * min(1.0, self.strength / max(float(np.linalg.norm(way)), 1e-9))
