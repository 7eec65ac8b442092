"""The behaviour policy that collects pour_water data: pouring, pauses, corrections, exploration."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from acwm_particle.cup import THICKNESS, tilted
from acwm_particle.water import Water

MAX_STEP = np.array([0.07, 0.05, 0.07, 0.11])
"""Largest movement of the target per frame: metres along x, y, z, and tilt in rad."""

_LEVEL_MARGIN = 0.17  # rad between the tilt of the approach and the tilt at which water flows


class Pourer:
    """Pours most of the water into the container, in one or several steps.

    Args:
        water: water, cup and container, changed only through actions.
        rng: source of all its randomness.
    """

    def __init__(self, water: Water, rng: np.random.Generator) -> None:
        self.water, self.rng, self.cup = water, rng, water.cup
        self._noise = np.zeros(4)
        self._actions = self._play()

    def next_action(self) -> NDArray[np.float64]:
        """The next action [4]; see `PourWater`."""
        return next(self._actions)

    def _play(self) -> Iterator[NDArray[np.float64]]:
        rng = self.rng
        yield from self._wait(rng.integers(0, 10))
        while True:
            if rng.random() < 0.5:
                yield from self._explore()
            yield from self._pour()
            yield from self._leave()
            yield from self._wait(rng.integers(0, 8))

    def _explore(self) -> Iterator[NDArray[np.float64]]:
        """Make small movements and tilts away from the container, too small to spill."""
        rng = self.rng
        for _ in range(int(rng.integers(1, 3))):
            away = [rng.uniform(-1.35, -1.0), rng.uniform(-0.3, 0.3), rng.uniform(1.0, 1.7)]
            tilt = rng.uniform(-0.5, 1.0) * 0.6 * (self._flows_at() - _LEVEL_MARGIN)
            yield from self._go([*away, tilt], rng.uniform(0.35, 0.8))
            yield from self._wait(rng.integers(0, 4))

    def _pour(self) -> Iterator[NDArray[np.float64]]:
        """Bring the lip over the container and tilt until enough water has flowed."""
        rng, container = self.rng, self.cup.container
        ready = self._flows_at() - _LEVEL_MARGIN
        lip = np.array(
            [
                self.cup.place[0] - container.inner + rng.uniform(0.18, 0.3),
                self.cup.place[1] + rng.normal(0, 0.04),
                container.tall + THICKNESS + rng.uniform(0.12, 0.4),
            ]
        )
        pace = rng.uniform(0.5, 0.9)
        beside = lip - [rng.uniform(0.35, 0.5), 0, -0.15]
        for place, tilt in ((beside, 0.6 * ready), (lip, ready)):
            yield from self._go([*self._clear(place, tilt), tilt], pace)
        rate, share = rng.uniform(0.008, 0.035), self.water.shares()[0]
        wanted = 0.0 if rng.random() < 0.4 else rng.uniform(0.3, 0.75) * share
        last, tilt = rng.uniform(1.9, 2.15), ready
        while tilt < last and self.water.shares()[0] > wanted + 0.01:
            flow = share - self.water.shares()[0]
            share -= flow
            tilt += rate * (0.15 if flow > 0.02 else 1.0)
            if rng.random() < 0.03:
                yield from self._wait(rng.integers(2, 9))
            if rng.random() < 0.02:
                tilt -= rng.uniform(0.05, 0.15)
            lip[:2] += rng.normal(0, 0.006, 2)
            lip[1] += 0.1 * (self.cup.place[1] - lip[1])
            yield self._towards([*self._clear(lip, tilt), tilt], 1.0)
        yield from self._wait(rng.integers(2, 12))

    def _leave(self) -> Iterator[NDArray[np.float64]]:
        """Tilt back, move beside the container and turn upright somewhere else."""
        rng, pose = self.rng, self.cup.target
        tilt = min(float(pose[3]), self._flows_at() - _LEVEL_MARGIN)
        lip = self._lip(pose)
        yield from self._go([*self._clear(lip, tilt), tilt], rng.uniform(0.6, 1.0))
        x = self.cup.place[0] - self.cup.container.outer - self.cup.shape.outer
        away = [x - rng.uniform(0.05, 0.25), rng.uniform(-0.25, 0.25), rng.uniform(1.0, 1.6)]
        raised = [float(pose[0]) - 0.35, float(pose[1]), max(float(self.cup.target[2]), away[2])]
        yield from self._go([*raised, 0.7 * tilt], 0.8)
        yield from self._go([*away, rng.uniform(-0.1, 0.1)], rng.uniform(0.4, 0.9))

    def _flows_at(self) -> float:
        """The tilt at which the water left in the cup reaches its lip."""
        shape, share = self.cup.shape, self.water.shares()[0]
        level = share * self.water.level
        room = shape.tall - level
        if level * 2 >= shape.tall or room < shape.inner * 2:
            at = np.arctan(room / shape.inner)
        else:
            at = np.arctan(shape.tall / shape.inner)
        return float(np.clip(at, 0.2, 1.15))

    def _center(self, lip: NDArray[np.float64], tilt: float) -> NDArray[np.float64]:
        """Position of the cup's middle for a position of its lip."""
        shape = self.cup.shape
        return lip - tilted(tilt) @ [shape.outer, 0.0, shape.tall / 2]

    def _clear(self, lip: NDArray[np.float64], tilt: float) -> NDArray[np.float64]:
        """Like `_center`, but raised if the cup's lowest corner would hit container or table."""
        container, tall = self.cup.container, self.cup.shape.tall + THICKNESS
        corner = lip[0] - tall * np.sin(tilt)
        beside = corner < self.cup.place[0] - container.outer - 0.06
        low = 0.06 + (0.0 if beside else container.tall + THICKNESS)
        height = max(float(lip[2]), low + tall * float(np.cos(tilt)))
        return self._center(np.array([lip[0], lip[1], height]), tilt)

    def _lip(self, pose: NDArray[np.float64]) -> NDArray[np.float64]:
        shape = self.cup.shape
        return pose[:3] + tilted(float(pose[3])) @ [shape.outer, 0.0, shape.tall / 2]

    def _towards(self, goal: list[float], pace: float) -> NDArray[np.float64]:
        """A step of the target, with noise like that of a hand."""
        self._noise = 0.8 * self._noise + self.rng.normal(0, 1, 4) * [0.002, 0.002, 0.002, 0.002]
        gap = np.asarray(goal) - self.cup.target
        gap *= min(1.0, pace / max(float((np.abs(gap) / MAX_STEP).max()), 1e-9))
        return gap + self._noise

    def _go(self, goal: list[float], pace: float) -> Iterator[NDArray[np.float64]]:
        """Move the target to a pose, all coordinates at the same time, slowly at both ends."""
        began = 0
        while True:
            gap = np.abs(np.asarray(goal) - self.cup.target) / MAX_STEP
            if gap.max() < 0.3 or began > 60:
                return
            began += 1
            ease = min(1.0, 0.3 + 0.2 * began, 0.25 + 0.3 * float(gap.max()))
            yield self._towards(goal, pace * ease)

    def _wait(self, frames: int | np.integer) -> Iterator[NDArray[np.float64]]:
        for _ in range(int(frames)):
            yield np.zeros(4)
