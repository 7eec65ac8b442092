"""Paths for the pole around the rope."""

import itertools

import numpy as np
from numpy.typing import NDArray

from acwm_deformable.rope import POLE_ROOM

Point = NDArray[np.float64]

_CELL = 0.06  # grid spacing in metres
_STEPS = [(dy, dx) for dy, dx in itertools.product((-1, 0, 1), repeat=2) if dy or dx]


class ClearanceGrid:
    """A grid of pole positions that are at least `reach` away from the rope.

    Args:
        nodes: [N, 2] nodes of the rope in metres.
        start: [2] position of the pole; if it is closer than `reach`, its distance is used instead.
        reach: distance in metres between the centres of pole and rope.
    """

    def __init__(self, nodes: NDArray[np.floating], start: Point, reach: float) -> None:
        self._nodes, self._start = nodes, start
        self._reach = min(reach, float(self._gap(start)) - 1e-6)
        x, y = (np.linspace(-side, side, 1 + round(2 * side / _CELL)) for side in POLE_ROOM)
        self._places = np.stack(np.meshgrid(x, y), axis=-1)
        self._free = self._gap(self._places) >= self._reach
        self._cost = self._spread()

    def cost(self, place: Point) -> float:
        """Length in metres of the path to a position; infinite if there is none."""
        inside = (np.abs(place) <= POLE_ROOM).all()
        return float(self._cost[self._cell(place)]) if inside else np.inf

    def way(self, place: Point) -> list[Point]:
        """Corners of a short path to a position with finite cost; the position itself is last."""
        cell, cells = self._cell(place), list[tuple[int, int]]()
        while self._cost[cell] > 0:
            cells.append(cell)
            near = [(cell[0] + dy, cell[1] + dx) for dy, dx in _STEPS]
            cell = min(near, key=lambda c: self._cost[c] if self._has(c) else np.inf)
        points = [self._start, *(self._places[c] for c in reversed(cells)), place]
        return self._straightened(points)

    def _straightened(self, points: list[Point]) -> list[Point]:
        """Skip points where a straight free line is possible."""
        corners, here = list[Point](), 0
        while here < len(points) - 1:
            ahead = len(points) - 1
            while ahead > here + 1 and not self._clear(points[here], points[ahead]):
                ahead -= 1
            corners.append(points[ahead])
            here = ahead
        return corners

    def _clear(self, a: Point, b: Point) -> bool:
        count = 2 + int(np.linalg.norm(b - a) / (0.5 * _CELL))
        line = a + np.linspace(0, 1, count)[:, None] * (b - a)
        return bool((self._gap(line) >= self._reach).all())

    def _gap(self, places: NDArray[np.floating]) -> NDArray[np.float64]:
        """Distance of positions [..., 2] to the nearest node."""
        away = places[..., None, :] - self._nodes
        return np.sqrt((away**2).sum(-1).min(-1))

    def _spread(self) -> NDArray[np.float64]:
        """Length of the shortest path to every cell, by relaxation over the eight neighbours."""
        rows, columns = self._free.shape
        cost = np.full((rows + 2, columns + 2), np.inf)
        inner = cost[1:-1, 1:-1]
        inner[self._cell(self._start)] = 0.0
        while True:
            before = inner.copy()
            for dy, dx in _STEPS:
                come = cost[1 + dy : 1 + dy + rows, 1 + dx : 1 + dx + columns]
                shorter = self._free & (come + _CELL * np.hypot(dy, dx) < inner)
                np.copyto(inner, come + _CELL * np.hypot(dy, dx), where=shorter)
            if np.array_equal(before, inner):
                return inner.copy()

    def _cell(self, place: Point) -> tuple[int, int]:
        column, row = np.rint((place + POLE_ROOM) / _CELL).astype(int)
        return int(row), int(column)

    def _has(self, cell: tuple[int, int]) -> bool:
        rows, columns = self._free.shape
        return 0 <= cell[0] < rows and 0 <= cell[1] < columns
