"""The scripted behaviour policy that collects push_rope data."""

from collections.abc import Generator, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_deformable.physics import POLE_RADIUS
from acwm_deformable.rope import NODES, POLE_ROOM, Rope
from acwm_deformable.rope_paths import ClearanceGrid

Point = NDArray[np.float64]

_CLEARANCE = 0.025
"""Gap in metres between pole and rope before a push and on the way around the rope."""

_GOALS = (0.9, 0.78)
"""Half width and half depth in metres of the rectangle in which pushes end."""

_PATIENCE = 0.3
"""Decay length in metres: pushes that start much further away are rarely chosen."""

_SAFE = (1.02, 0.9)
"""Half width and half depth in metres of the rectangle that pushes should keep the rope in."""

_DRIFT = 0.02
"""Outward speed in m/s times coordinate in m above which the rope is leaving the view."""

_MISSES = 3
"""Frames without touching the rope after which a push is given up."""


@dataclass(frozen=True)
class Push:
    """A push: a path to the rope, then a motion in a direction, which may change.

    Attributes:
        way: corners of the path, [2] metres each; the push starts at the last one.
        heading: angle of the first step in radians.
        turn: change of the heading per frame in radians.
        length: length of the push in metres.
    """

    way: list[Point]
    heading: float
    turn: float
    length: float


class Pusher:
    """Moves the pole. Mostly it goes to a point of the rope and pushes it sideways.

    Sometimes it pauses, or wanders, which may also push the rope.

    Args:
        rope: the simulation, which it observes.
        most: largest step of the pole along an axis in a frame, metres.
        rng: source of all its randomness.
    """

    def __init__(self, rope: Rope, most: float, rng: np.random.Generator) -> None:
        self.rope, self.most, self.rng = rope, most, rng
        self.target = self.place
        self.speed = 0.8 * most
        self._steps = self._live()

    @property
    def place(self) -> Point:
        """The position of the pole, [2] metres."""
        return self.rope.pole.astype(np.float64)

    def next_move(self) -> Point:
        """The displacement of the pole for the next frame, [2] metres."""
        self.target = np.clip(next(self._steps), np.negative(POLE_ROOM), POLE_ROOM)
        return np.clip(self.target - self.place, -self.most, self.most)

    def _live(self) -> Iterator[Point]:
        """Push, wander and pause endlessly."""
        while True:
            self.speed = self.most * self.rng.uniform(0.62, 0.98)
            choice = self.rng.random()
            if choice < 0.82:
                yield from self._push()
            elif choice < 0.94:
                yield from self._wander()
            else:
                yield from self._pause(int(self.rng.integers(2, 6)))

    def _pause(self, frames: int) -> Iterator[Point]:
        for _ in range(frames):
            yield self.target

    def _wander(self) -> Iterator[Point]:
        """Drift towards the rope with slow turns; turn back towards the middle near the rim."""
        to_rope = self.rope.nodes[self.rng.integers(NODES)] - self.target
        heading = np.arctan2(to_rope[1], to_rope[0])
        for _ in range(int(self.rng.integers(6, 14))):
            heading += self.rng.normal(0, 0.4)
            if (np.abs(self.target + 2 * self.speed * ahead_of(heading)) > _GOALS).any():
                heading = np.arctan2(-self.target[1], -self.target[0]) + self.rng.normal(0, 0.3)
            yield self.target + self.speed * ahead_of(heading)
            if self._straying():
                return

    def _push(self) -> Generator[Point]:
        """Go to the rope, push it, and back off a little."""
        plan = self._plan()
        if plan is None:
            yield from self._wander()
            return
        for corner in plan.way:
            yield from self._straight(corner, 0.98 * self.most)
        heading, missed = plan.heading, 0
        for _ in range(round(plan.length / self.speed)):
            yield self.target + self.speed * ahead_of(heading)
            heading += plan.turn
            missed = 0 if self.rope.touched else missed + 1
            done = missed > _MISSES or _room(self.target, heading) < self.speed
            if done or self._straying():
                break
        if self.rng.random() < 0.25:
            yield from self._pause(int(self.rng.integers(1, 4)))
        back = self.rng.uniform(0.03, 0.1)
        yield from self._straight(self.target - back * ahead_of(heading), self.speed)

    def _plan(self) -> Push | None:
        """Choose one of several random pushes that can be started, preferably a near one."""
        chart = ClearanceGrid(self.rope.nodes, self.place, self._contact)
        options = [self._propose() for _ in range(32)]
        cost = np.array([chart.cost(start) for start, _, _ in options])
        room = np.array([_room(start, heading) for start, heading, _ in options])
        weight = np.exp(-cost / _PATIENCE) * np.clip(room - 0.2, 0.0, 0.5)
        outward = np.sign(self.rope.nodes) * (np.abs(self.rope.nodes) > 0.9 * np.array(_SAFE))
        headings = np.array([ahead_of(heading) for _, heading, _ in options])
        weight[(headings @ outward.T > 0.2).any(1)] *= 0.01
        if not weight.any():
            return None
        start, heading, length = options[self.rng.choice(len(options), p=weight / weight.sum())]
        turn = self.rng.normal(0, 0.09) if self.rng.random() < 0.4 else 0.0
        return Push(chart.way(start), heading, turn, length)

    def _propose(self) -> tuple[Point, float, float]:
        """Start, heading and length of a sideways push at a random point of the rope."""
        nodes, rng = self.rope.nodes.astype(np.float64), self.rng
        near_end = rng.random() < 0.2
        node = int(rng.choice((0, NODES - 1))) if near_end else int(rng.integers(4, NODES - 4))
        along = nodes[min(node + 3, NODES - 1)] - nodes[max(node - 3, 0)]
        heading = np.arctan2(along[1], along[0]) + rng.choice((-0.5, 0.5)) * np.pi
        heading += rng.normal(0, 0.6 if near_end else 0.3)
        start = nodes[node] - ahead_of(heading) * (self._contact + 0.01)
        return start, float(heading), float(rng.uniform(0.35, 1.2))

    def _straight(self, finish: Point, speed: float) -> Iterator[Point]:
        """Move straight to `finish`, within the room, at `speed` metres per frame."""
        finish = np.clip(finish, np.negative(POLE_ROOM), POLE_ROOM)
        while np.linalg.norm(finish - self.target) > 1e-3:
            gap = finish - self.target
            yield self.target + gap * min(1.0, speed / float(np.linalg.norm(gap)))

    def _straying(self) -> bool:
        """Whether the rope is moving out of the camera's view."""
        nodes, velocities = self.rope.nodes, self.rope.velocities
        return bool(((np.abs(nodes) > _SAFE) & (nodes * velocities > _DRIFT)).any())

    @property
    def _contact(self) -> float:
        """Distance between the centres of pole and rope at which they cannot touch."""
        return POLE_RADIUS + self.rope.cord.radius + _CLEARANCE


def ahead_of(heading: float) -> Point:
    """The direction [2] of a heading in rad."""
    return np.array([np.cos(heading), np.sin(heading)])


def _room(place: Point, heading: float) -> float:
    """Distance in metres from a place along a heading to the edge of the goals, 0 if past it."""
    ahead = ahead_of(heading)
    ahead = np.where(np.abs(ahead) < 1e-6, 1e-6, ahead)
    return max(0.0, float(((np.array(_GOALS) - np.sign(ahead) * place) / np.abs(ahead)).min()))
