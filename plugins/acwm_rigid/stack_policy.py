"""The behaviour policy that collects stack_cube data: red onto green, in varying manners."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_rigid.stack_simulation import DOWN, GREEN, RED, StackSimulation, rotation_between, turned

MAX_STEP = 0.048
"""Largest movement of the hand's target per frame in metres."""

MAX_TURN = 0.18
"""Largest rotation per frame in radians, on average over a motion."""

_STILL, _CLOSE, _OPEN = 0.0, -1.0, 1.0
_QUARTER = np.pi / 2
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Manner:
    """How one episode is performed; lengths in metres, durations in frames.

    Attributes:
        hover: height above a cube's centre from which the hand comes down.
        lift: height to which the cube is lifted for the transport.
        pace: speed of the hand as a share of `MAX_STEP`.
        detour: a point on the way to the red cube, or None.
        swing: sideways bend of the way to the green cube.
        offset: [2] where the red cube is put on the green one, relative to its centre.
        align: whether the red cube is rotated to lie square on the green one.
        tilts: [3, 2] tilts of the hand about x and y in radians: at the detour, above the red cube,
            and half way to the green one.
        tremor: standard deviation of the hand's deviation from its path, where nothing is near.
        pauses: frames of rest before the grasp and before the release.
    """

    hover: float
    lift: float
    pace: float
    detour: NDArray[np.float64] | None
    swing: float
    offset: NDArray[np.float64]
    align: bool
    tilts: NDArray[np.float64]
    tremor: float
    pauses: tuple[int, int]

    @classmethod
    def draw(cls, edge: float, rng: np.random.Generator) -> "Manner":
        """Draw a random manner for cubes with this edge."""
        around = rng.uniform([0.38, -0.18, 0.18], [0.58, 0.18, 0.32])
        return cls(
            hover=float(rng.uniform(0.08, 0.13)),
            lift=float(edge + rng.uniform(0.045, 0.09)),
            pace=float(rng.uniform(0.6, 1.0)),
            detour=around if rng.random() < 0.3 else None,
            swing=float(rng.uniform(-0.06, 0.06)),
            offset=rng.normal(0, 0.06 * edge, 2).clip(-0.12 * edge, 0.12 * edge),
            align=bool(rng.random() < 0.8),
            tilts=rng.uniform(-0.25, 0.25, (3, 2)) * (rng.random((3, 1)) < 0.6),
            tremor=float(rng.uniform(0.0, 0.005)),
            pauses=(int(rng.integers(0, 2)), int(rng.integers(0, 2))),
        )


class Stacker:
    """Puts the red cube onto the green one.

    Args:
        world: the simulation to act in.
        rng: source of all randomness.
    """

    def __init__(self, world: StackSimulation, rng: np.random.Generator) -> None:
        self.world, self.rng = world, rng
        self.manner = Manner.draw(world.edge, rng)
        self._turn = np.zeros(3)  # tilt about x and y, then angle about z
        self._actions = self._play()

    def next_action(self) -> NDArray[np.float64]:
        """The next action [7]; see `StackCube`."""
        return next(self._actions)

    def _play(self) -> Iterator[NDArray[np.float64]]:
        yield from self._grasp()
        yield from self._place()
        yaw = float(self._turn[2])
        while True:
            away = self.rng.uniform([0.35, -0.2, 0.22], [0.55, 0.2, 0.34])
            tilt, grip = self.rng.uniform(-0.25, 0.25, 2), float(self.rng.uniform(-0.7, 0.7))
            yield from self._move(away, yaw, tilt=tilt, pace=0.6)
            yield from self._rest(int(self.rng.integers(2, 8)), grip)

    def _grasp(self) -> Iterator[NDArray[np.float64]]:
        """Go to the red cube, perhaps with a detour, grasp it and lift it."""
        manner = self.manner
        if manner.detour is not None:
            fumble = float(self.rng.uniform(-0.4, 0.0))
            yield from self._move(
                manner.detour, 0.0, fumble, tilt=manner.tilts[0], pace=1.0, least=4
            )
        red, yaw = self._cube(RED)
        above, yaw = red + manner.hover * _UP, _nearest_quarter(yaw)
        yield from self._move(above, yaw, _OPEN, tilt=manner.tilts[1])
        yield from self._move(red, yaw, least=3, careful=True)
        yield from self._rest(manner.pauses[0], _STILL)
        yield from self._rest(4, _CLOSE)
        yield from self._move(red + manner.lift * _UP, yaw, careful=True)

    def _place(self) -> Iterator[NDArray[np.float64]]:
        """Carry the cube over the green one, put it down, let go and rise."""
        manner, edge, yaw = self.manner, self.world.edge, float(self._turn[2])
        green, green_yaw = self._cube(GREEN)
        place = green + np.array([*manner.offset, edge + 0.003])
        if manner.align:
            yaw = _nearest_quarter(green_yaw + yaw - self._cube(RED)[1], yaw)
        above = place + (manner.lift - edge) * _UP
        way, halfway = above - self.world.position, (self._turn[2] + yaw) / 2
        side = np.array([-way[1], way[0], 0.0]) / max(float(np.linalg.norm(way[:2])), 1e-6)
        middle = self.world.position + way / 2 + side * manner.swing
        yield from self._move(middle, halfway, tilt=manner.tilts[2], ease=False)
        yield from self._move(above, yaw)
        yield from self._move(place, yaw, least=3, careful=True)
        yield from self._rest(1 + manner.pauses[1], _STILL)
        yield from self._rest(2, _OPEN)
        yield from self._move(place + manner.hover * _UP, yaw, careful=True)

    def _move(
        self,
        goal: NDArray[np.float64],
        yaw: float,
        grip: float = _STILL,
        *,
        tilt: ArrayLike = (0.0, 0.0),
        pace: float | None = None,
        least: int = 2,
        ease: bool = True,
        careful: bool = False,
    ) -> Iterator[NDArray[np.float64]]:
        """Move the target to `goal` [3], tilted by `tilt` [2] and rotated by `yaw`.

        With `ease` it moves slower at both ends; with `careful` it does not deviate from the path.
        """
        start, first = self.world.position.copy(), self._turn.copy()
        last = np.array([*np.asarray(tilt, float), yaw])
        speed = MAX_STEP * (self.manner.pace if pace is None else pace)
        peak = 1.25 if ease else 1.0
        frames = max(least, int(np.ceil(peak * np.linalg.norm(goal - start) / speed)))
        frames = max(frames, int(np.ceil(np.abs(last - first).max() / MAX_TURN)))
        tremor = 0.0 if careful else self.manner.tremor
        for frame in range(1, frames + 1):
            share = frame / frames
            if ease:  # half linear, half cosine
                share = 0.5 * share + 0.25 * (1 - np.cos(np.pi * share))
            self._turn = first + share * (last - first)
            wanted = start + share * (goal - start)
            if frame < frames:
                wanted += tremor * self.rng.normal(size=3).clip(-2, 2)
            yield np.array([*(wanted - self.world.position), *self._rotation(), grip])

    def _rotation(self) -> NDArray[np.float64]:
        """The rotation vector [3] from the hand's current target orientation to `_turn`."""
        wanted = turned(turned(DOWN, [0.0, 0.0, self._turn[2]]), [*self._turn[:2], 0.0])
        return rotation_between(self.world.rotation, wanted)

    def _rest(self, frames: int, grip: float) -> Iterator[NDArray[np.float64]]:
        for _ in range(frames):
            yield np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, grip])

    def _cube(self, which: int) -> tuple[NDArray[np.float64], float]:
        centers, turns = self.world.cube_pose
        x, y, z, w = turns[which]
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return centers[which], float(yaw)


def _nearest_quarter(yaw: float, near: float = 0.0) -> float:
    """The angle closest to `near` that equals `yaw` up to quarter turns, as a cube is symmetric."""
    return yaw - _QUARTER * round((yaw - near) / _QUARTER)
