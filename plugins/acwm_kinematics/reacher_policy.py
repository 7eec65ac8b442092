"""The scripted behaviour policy that collects reacher data, and the region of its targets."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_kinematics.reacher_arm import Arm, Vector

SECTOR = np.pi / 8
"""Half the angle of a corner sector; the four sectors cover half of all directions."""

_FRAME = 0.1  # seconds between two actions
# Feedback on the errors of angle and velocity that remain after a frame of constant torque:
# the two poles are at 0.57, so that an error falls to a tenth after four frames.
_PULL, _BRAKE = 0.25 / _FRAME**2, 0.8 / _FRAME
_FASTEST, _SLOWEST = 6, 30  # frames that a motion may take


@dataclass(frozen=True)
class Region:
    """The region of goals: a part of the disc that the arm can reach.

    Attributes:
        corners: whether goals lie in the corner sectors, that is towards a corner of the walls and
            far out; otherwise they lie anywhere outside these sectors.
    """

    corners: bool

    def sample(self, reach: float, rng: np.random.Generator) -> Vector:
        """Draw a point [2] in metres, uniformly over the region's area."""
        inner, outer = (0.62, 0.96) if self.corners else (0.25, 0.96)
        while True:
            radius = np.sqrt(rng.uniform(inner**2, outer**2))
            angle = rng.uniform(-np.pi, np.pi)
            point = reach * radius * np.array([np.cos(angle), np.sin(angle)])
            if in_corner_sector(point, reach, margin=0.0 if self.corners else 0.04) == self.corners:
                return point


def in_corner_sector(point: NDArray[np.floating], reach: float, margin: float = 0.0) -> bool:
    """Whether a point [2], in metres, is in one of the four sectors that training leaves out.

    They lie around the diagonals, from 0.62 of the reach outwards. `margin` extends them by this
    share of the reach at their inner rim, and by this many radians to each side.
    """
    off = abs((np.arctan2(point[1], point[0]) % (np.pi / 2)) - np.pi / 4)
    return bool(off <= SECTOR + margin and np.hypot(*point) >= (0.62 - margin) * reach)


class Reacher:
    """Drives the arm: it reaches for the goal, holds, tries torques and reaches elsewhere.

    Args:
        arm: the simulation, which it observes.
        goal: [2] metres.
        region: the region of its other targets.
        limits: least and largest torque that it uses, N·m.
        rng: source of all its randomness.
    """

    def __init__(
        self,
        arm: Arm,
        goal: Vector,
        region: Region,
        limits: tuple[float, float],
        rng: np.random.Generator,
    ) -> None:
        self.arm, self.goal, self.region, self.limits, self.rng = arm, goal, region, limits, rng
        self.tremble = rng.uniform(0.0, 0.4)  # N·m of noise on top of what a motion needs
        self._steps = self._live()

    def next_torque(self) -> Vector:
        """Torques [2] for the next frame, N·m."""
        return np.clip(next(self._steps), *self.limits)

    def insist(self) -> None:
        """From now on reach only for the goal, repeatedly and without noise."""
        self.tremble, self._steps = 0.0, self._insist()

    def _insist(self) -> Iterator[Vector]:
        while True:
            yield from self._reach(self.goal)

    def _live(self) -> Iterator[Vector]:
        """Reach for the goal at some point, and do other things before and after, endlessly."""
        if self.rng.random() < 0.4:
            yield from self._explore(int(self.rng.integers(4, 13)))
        yield from self._reach(self.goal)
        while True:
            choice = self.rng.random()
            if choice < 0.35:
                yield from self._explore(int(self.rng.integers(6, 16)))
            elif choice < 0.45:
                yield from self._coast(int(self.rng.integers(3, 9)))
            elif choice < 0.75:
                yield from self._reach(self.region.sample(self.arm.links.reach, self.rng))
            else:
                yield from self._reach(self.goal)

    def _coast(self, frames: int) -> Iterator[Vector]:
        """Apply no torque, so that the arm slows down by itself."""
        for _ in range(frames):
            yield np.zeros(2)

    def _explore(self, frames: int) -> Iterator[Vector]:
        """Apply randomly drifting torques, sometimes with a kick of full strength."""
        middle, spread = np.mean(self.limits), np.ptp(self.limits) / 2
        size, torque = self.rng.uniform(0.2, 0.7), self.rng.normal(0, 0.5, 2)
        for _ in range(frames):
            torque = 0.7 * torque + self.rng.normal(0, 0.7, 2)
            if self.rng.random() < 0.06:
                torque[self.rng.integers(2)] = self.rng.choice((-1.0, 1.0)) / size
            yield middle + spread * size * torque

    def _reach(self, target: Vector) -> Iterator[Vector]:
        """Bring the fingertip to `target` along a smooth motion and hold it there for a while."""
        start, rate = self.arm.angles, self.arm.velocities
        end = self._posture(target)
        frames = self._pace(start, rate, end)
        for k in range(frames):
            yield self._follow(*_motion(start, rate, end, frames, k + 1)) + self._noise()
        for _ in range(int(self.rng.integers(2, 8))):
            yield self._follow(end, np.zeros(2)) + self._noise()

    def _noise(self) -> Vector:
        return self.rng.normal(0.0, self.tremble, 2)

    def _posture(self, target: Vector) -> Vector:
        """Angles that reach `target`, mostly the nearer of the two solutions."""
        return self.arm.postures_for(target)[int(self.rng.random() < 0.15)]

    def _pace(self, start: Vector, rate: Vector, end: Vector) -> int:
        """Number of frames for a motion that stays within a random share of the torque limits."""
        room = self.rng.uniform(0.45, 0.9) * np.abs(self.limits).min()
        for frames in range(_FASTEST, _SLOWEST):
            path = (_motion(start, rate, end, frames, k) for k in range(frames + 1))
            torques = (
                self.arm.torque_for((a + c) / 2, (b + d) / 2, (d - b) / _FRAME)
                for (a, b), (c, d) in itertools.pairwise(path)
            )
            if all(np.abs(torque).max() <= room for torque in torques):
                return frames
        return _SLOWEST

    def _follow(self, angles: Vector, velocities: Vector) -> Vector:
        """Computed torque control: torques to have these angles and velocities one frame later."""
        here, rate = self.arm.angles, self.arm.velocities
        wanted = (velocities - rate) / _FRAME
        # The remaining angle once the velocities agree; a part of it is corrected each frame.
        left = angles - here - _FRAME * (velocities + rate) / 2
        speed_up = _BRAKE * _FRAME * wanted + _PULL * left
        ahead = here + _FRAME * (rate + _FRAME * speed_up / 4) / 2  # the middle of the frame
        return self.arm.torque_for(ahead, rate + _FRAME * speed_up / 2, speed_up)


def _motion(start: Vector, rate: Vector, end: Vector, frames: int, k: int) -> tuple[Vector, Vector]:
    """Angles and velocities after frame k of the quintic from `start` at `rate` to rest at `end`.

    Accelerations are zero at both ends. From rest it is the minimum-jerk motion (Flash and Hogan
    1985).
    """
    s, seconds = k / frames, frames * _FRAME
    gap, pace = end - start, rate * seconds
    c3, c4, c5 = 10 * gap - 6 * pace, -15 * gap + 8 * pace, 6 * gap - 3 * pace
    angles = start + pace * s + c3 * s**3 + c4 * s**4 + c5 * s**5
    velocities = (pace + 3 * c3 * s**2 + 4 * c4 * s**3 + 5 * c5 * s**4) / seconds
    return angles, velocities
