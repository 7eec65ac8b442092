"""The behaviour that collects data: red onto green, each time in another manner."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_rigid.stack_world import GREEN, RED, StackWorld

MAX_STEP = 0.048
"""Metres that the hand's target moves per frame at most."""

_STILL, _CLOSE, _OPEN = 0.0, -1.0, 1.0
_QUARTER = np.pi / 2


@dataclass(frozen=True)
class Manner:
    """How one episode is done; lengths in metres, durations in frames.

    Attributes:
        hover: height above a cube's centre from which the hand comes down.
        lift: height to which the cube is lifted for the way.
        pace: share of `MAX_STEP` at which it moves.
        detour: a point that the way to the red cube leads through, or None.
        swing: how far the way to the green cube bends sideways.
        offset: [2] where on the green cube the red one is put, from its middle.
        align: whether the cube is turned to lie square on the other.
        pauses: frames of rest before the grasp and before the release.
    """

    hover: float
    lift: float
    pace: float
    detour: NDArray[np.float64] | None
    swing: float
    offset: NDArray[np.float64]
    align: bool
    pauses: tuple[int, int]

    @classmethod
    def draw(cls, edge: float, rng: np.random.Generator) -> "Manner":
        """A manner drawn at random for cubes of this edge."""
        around = rng.uniform([0.38, -0.18, 0.18], [0.58, 0.18, 0.32])
        return cls(
            hover=float(rng.uniform(0.08, 0.13)),
            lift=float(edge + rng.uniform(0.045, 0.09)),
            pace=float(rng.uniform(0.6, 1.0)),
            detour=around if rng.random() < 0.3 else None,
            swing=float(rng.uniform(-0.06, 0.06)),
            offset=rng.normal(0, 0.06 * edge, 2).clip(-0.12 * edge, 0.12 * edge),
            align=bool(rng.random() < 0.8),
            pauses=(int(rng.integers(0, 2)), int(rng.integers(0, 2))),
        )


class Stacker:
    """Puts the red cube onto the green one.

    Args:
        world: where.
        rng: draws the manner.
    """

    def __init__(self, world: StackWorld, rng: np.random.Generator) -> None:
        self.world, self.rng = world, rng
        self.manner = Manner.draw(world.edge, rng)
        self._yaw = 0.0
        self._actions = self._play()

    def next_action(self) -> NDArray[np.float64]:
        """The next action [7]; see `StackCube`."""
        return next(self._actions)

    def _play(self) -> Iterator[NDArray[np.float64]]:
        world, manner, up = self.world, self.manner, np.array([0.0, 0.0, 1.0])
        if manner.detour is not None:
            yield from self._move(manner.detour, 0.0, _STILL, pace=1.0, least=4)
        red, yaw = self._cube(RED)
        grasp = _nearest_quarter(yaw)
        yield from self._move(red + manner.hover * up, grasp, _OPEN)
        yield from self._move(red, grasp, _STILL, least=3)
        yield from self._rest(manner.pauses[0], _STILL)
        yield from self._rest(4, _CLOSE)
        yield from self._move(red + manner.lift * up, self._yaw, _STILL)
        green, green_yaw = self._cube(GREEN)
        place = green + np.array([*manner.offset, world.edge + 0.003])
        turn = _nearest_quarter(green_yaw + self._yaw - self._cube(RED)[1], self._yaw)
        yaw = turn if manner.align else self._yaw
        yield from self._carry(place + manner.lift * up - [0, 0, world.edge], yaw)
        yield from self._move(place, yaw, _STILL, least=3)
        yield from self._rest(1 + manner.pauses[1], _STILL)
        yield from self._rest(2, _OPEN)
        yield from self._move(place + manner.hover * up, yaw, _STILL)
        while True:
            away = self.rng.uniform([0.35, -0.2, 0.22], [0.55, 0.2, 0.34])
            yield from self._move(away, yaw, _STILL, pace=0.6)
            yield from self._rest(int(self.rng.integers(2, 8)), _STILL)

    def _carry(self, goal: NDArray[np.float64], yaw: float) -> Iterator[NDArray[np.float64]]:
        """Move to `goal` along a path that bends to the side."""
        way = goal - self.world.position
        side = np.array([-way[1], way[0], 0.0]) / max(float(np.linalg.norm(way[:2])), 1e-6)
        middle = self.world.position + way / 2 + side * self.manner.swing
        yield from self._move(middle, (self._yaw + yaw) / 2, _STILL, ease=False)
        yield from self._move(goal, yaw, _STILL)

    def _move(
        self,
        goal: NDArray[np.float64],
        yaw: float,
        grip: float,
        *,
        pace: float | None = None,
        least: int = 2,
        ease: bool = True,
    ) -> Iterator[NDArray[np.float64]]:
        """Bring the target to `goal` [3] and the hand to the angle `yaw`, slower at the ends."""
        start, first = self.world.position.copy(), self._yaw
        speed = MAX_STEP * (self.manner.pace if pace is None else pace)
        peak = 1.25 if ease else 1.0
        frames = max(least, int(np.ceil(peak * np.linalg.norm(goal - start) / speed)))
        frames = max(frames, int(np.ceil(abs(yaw - first) / 0.2)))
        for frame in range(1, frames + 1):
            share = frame / frames
            if ease:  # half linear, half cosine
                share = 0.5 * share + 0.25 * (1 - np.cos(np.pi * share))
            turn = first + share * (yaw - first) - self._yaw
            self._yaw += turn
            step = start + share * (goal - start) - self.world.position
            yield np.array([*step, 0.0, 0.0, turn, grip])

    def _rest(self, frames: int, grip: float) -> Iterator[NDArray[np.float64]]:
        for _ in range(frames):
            yield np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, grip])

    def _cube(self, which: int) -> tuple[NDArray[np.float64], float]:
        centers, turns = self.world.cube_pose
        x, y, z, w = turns[which]
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return centers[which], float(yaw)


def _nearest_quarter(yaw: float, near: float = 0.0) -> float:
    """The angle closest to `near` that is `yaw` but for quarter turns: a cube looks the same."""
    return yaw - _QUARTER * round((yaw - near) / _QUARTER)
