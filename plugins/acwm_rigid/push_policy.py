"""The scripted behaviour policy that collects push_cube data."""

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_rigid.physics import PUSHER_RADIUS
from acwm_rigid.push_simulation import PushSimulation

Point = NDArray[np.float64]

_CLEARANCE = 0.012
"""Gap in metres between pusher and cube before a push and on the way around the cube."""

_STUCK = 0.05
"""Distance in metres between target and pusher at which it gives up its plan and makes another."""


@dataclass(frozen=True)
class Region:
    """Goals of pushes: points whose larger absolute coordinate is in [`low`, `high`] metres."""

    low: float
    high: float

    def sample(self, rng: np.random.Generator) -> Point:
        """Draw a point from the region, evenly over its four sides."""
        along, outward = rng.uniform(-self.high, self.high), rng.uniform(self.low, self.high)
        outward *= rng.choice((-1.0, 1.0))
        point = np.array([outward, along])
        return point if rng.random() < 0.5 else point[::-1].copy()


class Pusher:
    """Moves one pusher. Mostly it pushes cubes to goals; sometimes it wanders or pauses.

    Args:
        table: the simulation, which it observes.
        index: index of the pusher that it moves.
        region: where it pushes cubes to.
        reach: largest coordinate of a target, metres.
        rng: source of all its randomness.
    """

    def __init__(
        self,
        table: PushSimulation,
        index: int,
        region: Region,
        reach: float,
        rng: np.random.Generator,
    ) -> None:
        self.table, self.index, self.region, self.reach, self.rng = table, index, region, reach, rng
        self.target = self.place
        self.speed = 0.032
        self._steps = self._live()

    @property
    def place(self) -> Point:
        """The position of the pusher, [2] metres."""
        return self.table.pusher_position[self.index]

    def next_target(self) -> Point:
        """The target for the next frame, [2] metres."""
        if np.linalg.norm(self.target - self.place) > _STUCK:
            self.target, self._steps = self.place, self._live()
        self.target = np.clip(next(self._steps), -self.reach, self.reach)
        return self.target

    def _live(self) -> Iterator[Point]:
        """Push, wander and pause endlessly."""
        while True:
            self.speed = self.rng.uniform(0.022, 0.042)
            choice = self.rng.random()
            if choice < 0.80:
                yield from self._push()
            elif choice < 0.93:
                yield from self._wander()
            else:
                yield from self._pause(int(self.rng.integers(3, 8)))

    def _pause(self, frames: int) -> Iterator[Point]:
        for _ in range(frames):
            yield self.target

    def _wander(self) -> Iterator[Point]:
        """Drift in slowly changing directions; turn back towards the middle near the rim."""
        heading = self.rng.uniform(0, 2 * np.pi)
        for _ in range(int(self.rng.integers(6, 14))):
            heading += self.rng.normal(0, 0.45)
            ahead = np.array([np.cos(heading), np.sin(heading)])
            if np.abs(self.target + 2 * self.speed * ahead).max() > self.reach:
                heading = np.arctan2(-self.target[1], -self.target[0]) + self.rng.normal(0, 0.3)
                ahead = np.array([np.cos(heading), np.sin(heading)])
            yield self.target + self.speed * ahead

    def _push(self) -> Generator[Point]:
        """Pick a cube and a goal, go behind the cube, push it to the goal and back off a little."""
        plan = self._plan()
        if plan is None:
            yield from self._wander()
            return
        cube, start, goal = plan
        yield from self._go_around(cube, start)
        offset = self.rng.normal(0, 0.2) * self.table.cubes.edge / 2
        ahead = goal - self._cube(cube)
        ahead /= np.linalg.norm(ahead) + 1e-9
        finish = goal - ahead * (self._contact - _CLEARANCE)
        finish = finish + offset * np.array([-ahead[1], ahead[0]])
        yield from self._straight(finish)
        if self.rng.random() < 0.3:
            yield from self._pause(int(self.rng.integers(1, 5)))
        yield from self._straight(self.place - ahead * self.rng.uniform(0.02, 0.06))

    def _plan(self) -> tuple[int, Point, Point] | None:
        """A cube, a reachable position behind it, and a goal at some distance; None if none fit."""
        for _ in range(40):
            cube = int(self.rng.integers(len(self.table.cubes.slots)))
            goal, center = self.region.sample(self.rng), self._cube(cube)
            ahead = goal - center
            length = float(np.linalg.norm(ahead))
            start = center - ahead / (length + 1e-9) * self._contact
            if length > 0.07 and np.abs(start).max() < self.reach:
                return cube, start, goal
        return None

    def _go_around(self, cube: int, start: Point) -> Iterator[Point]:
        """Move to `start` without touching the cube: on a circle around it if it is in the way."""
        center, radius = self._cube(cube), self._contact
        for _ in range(24):
            gap = start - self.target
            if np.linalg.norm(gap) < 0.5 * self.speed:
                return
            here, there = self.target - center, start - center
            if distance_to_line(center, self.target, start) < 0.97 * radius:
                angle = np.arctan2(here[1], here[0])
                turn = np.arctan2(there[1], there[0]) - angle
                turn = (turn + np.pi) % (2 * np.pi) - np.pi
                if np.linalg.norm(here) < 1.6 * radius:
                    angle += np.clip(turn, -self.speed / radius, self.speed / radius)
                    goal = center + radius * np.array([np.cos(angle), np.sin(angle)])
                else:
                    angle += np.clip(turn, -1.2, 1.2)
                    goal = center + 1.1 * radius * np.array([np.cos(angle), np.sin(angle)])
                gap = goal - self.target
            yield self._toward(gap)

    def _straight(self, finish: Point) -> Iterator[Point]:
        """Move straight to `finish`, as far as the reach allows and nothing is in the way."""
        finish = np.clip(finish, -self.reach, self.reach)
        while np.linalg.norm(finish - self.target) > 1e-3:
            yield self._toward(finish - self.target)

    def _toward(self, gap: Point) -> Point:
        length = float(np.linalg.norm(gap))
        return self.target + gap * min(1.0, self.speed / max(length, 1e-9))

    def _cube(self, cube: int) -> Point:
        return self.table.cube_pose[cube, :2]

    @property
    def _contact(self) -> float:
        """Distance between the centres of pusher and cube at which they cannot touch."""
        return self.table.cubes.edge / np.sqrt(2) + PUSHER_RADIUS + _CLEARANCE


def distance_to_line(point: Point, start: Point, end: Point) -> float:
    """Distance from a point to the segment between two others."""
    line = end - start
    along = np.clip((point - start) @ line / max(line @ line, 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(start + along * line - point))
