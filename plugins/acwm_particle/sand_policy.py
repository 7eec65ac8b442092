"""The behaviour policy that collects push_sand data: strokes of the board through the sand."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_particle.sand import CLEARANCE, Pose, Sand

MAX_STEP = 0.032
"""Largest movement of the board per frame in metres."""

MAX_TURN = 0.12
"""Largest change of a component of the quaternion per frame."""

ABOVE = 0.25
"""Height in metres of the board's centre when it is carried over the sand."""

_STROKES = {"push": 0.5, "cut": 0.2, "sweep": 0.2, "wander": 0.1}


def heading(yaw: float, tilt: float = 0.0) -> NDArray[np.float64]:
    """The orientation (w, x, y, z) of a board that faces `yaw` and tilts forward by `tilt`, rad."""
    c, s, a, b = np.cos(yaw / 2), np.sin(yaw / 2), np.cos(tilt / 2), np.sin(tilt / 2)
    return np.array([c * a, -s * b, c * b, s * a])


class Raker:
    """Moves the board, mostly in strokes through the sand.

    Args:
        sand: sand and board, which it observes; it changes them only through its actions.
        rng: source of all its randomness.
    """

    def __init__(self, sand: Sand, rng: np.random.Generator) -> None:
        self.sand, self.rng = sand, rng
        self._low = float(sand.half[2]) + CLEARANCE
        self._actions = self._play()

    def next_action(self) -> NDArray[np.float64]:
        """The next action [7]; see `PushSand`."""
        return next(self._actions)

    def _play(self) -> Iterator[NDArray[np.float64]]:
        kinds, shares = list(_STROKES), list(_STROKES.values())
        while True:
            yield from self._stroke(str(self.rng.choice(kinds, p=shares)))
            if self.rng.random() < 0.3:
                for _ in range(int(self.rng.integers(1, 5))):
                    yield np.zeros(7)

    def _stroke(self, kind: str) -> Iterator[NDArray[np.float64]]:
        rng, board = self.rng, self.sand.board
        if kind == "wander":
            yaw = rng.uniform(-np.pi, np.pi)
            place = [*rng.uniform([-0.35, -0.22], [0.35, 0.22]), rng.uniform(self._low, ABOVE)]
            yield from self._go(place, heading(yaw, rng.uniform(-0.3, 0.3)))
            return
        goal = self._sand_point()
        angle = rng.uniform(-np.pi, np.pi)
        if board.position[2] < self._low + 0.05 and rng.random() < 0.6:
            angle = np.arctan2(*(goal - board.position[:2])[::-1])  # continue from where it stands
        way = np.array([np.cos(angle), np.sin(angle)])
        # A cut moves edge-on, a push broadside, a sweep turns while it moves.
        yaw = angle + (np.pi / 2 if kind == "cut" else rng.normal(0, 0.15))
        yaw = self._nearest_face(yaw)
        start, end = goal - way * rng.uniform(0.14, 0.26), goal + way * rng.uniform(0.05, 0.22)
        tilt = rng.normal(0, 0.12)
        if np.linalg.norm(board.position[:2] - start) > 0.08:
            yield from self._go([*board.position[:2], ABOVE], heading(yaw), both=False)
            yield from self._go([*start, ABOVE], heading(yaw))
        yield from self._go([*start, self._low], heading(yaw, tilt))
        turn = rng.choice([-1, 1]) * rng.uniform(0.5, 1.2) if kind == "sweep" else 0.0
        pace = rng.uniform(0.5, 0.9)
        yield from self._go([*end, self._low], heading(yaw + turn, tilt), pace=pace)

    def _sand_point(self) -> NDArray[np.float64]:
        """Draw a point with sand, often near the middle of the sand."""
        grain = self.sand.grains[int(self.rng.integers(len(self.sand.grains))), :2]
        middle = self.sand.grains[:, :2].mean(0)
        return middle + self.rng.uniform(0.2, 1.0) * (grain - middle).astype(float)

    def _nearest_face(self, yaw: float) -> float:
        """The angle nearest to the current one that faces along `yaw` with either side."""
        w, _, _, z = self.sand.board.quaternion
        now = 2 * np.arctan2(z, w)
        return yaw - np.pi * np.round((yaw - now) / np.pi)

    def _go(
        self, place: ArrayLike, turn: NDArray[np.float64], *, pace: float = 1.0, both: bool = True
    ) -> Iterator[NDArray[np.float64]]:
        """Move the board to a pose at `pace` times full speed; without `both`, keep its angle."""
        pose = self.sand.board
        start, first = pose.position.copy(), pose.quaternion.copy()
        goal = np.asarray(place, float)
        last = (turn if first @ turn >= 0 else -turn) if both else first
        far = np.linalg.norm(goal - start) / (MAX_STEP * pace)
        turned = np.abs(last - first).max() / (MAX_TURN * 0.8)
        frames = max(1, int(np.ceil(max(far, turned))))
        for frame in range(1, frames + 1):
            share = frame / frames
            wanted = first + share * (last - first)
            wanted /= np.linalg.norm(wanted)
            now: Pose = self.sand.board
            step = start + share * (goal - start) - now.position
            yield np.concatenate([step, wanted - now.quaternion])
