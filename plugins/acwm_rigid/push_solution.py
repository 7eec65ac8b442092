"""Goal positions for push_cube's cubes, and a script that pushes the cubes there."""

import heapq
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from acwm_rigid.physics import PUSHER_RADIUS
from acwm_rigid.push_policy import Point, Region, distance_to_line
from acwm_rigid.push_simulation import PushSimulation

REACH = 0.26
"""Largest coordinate of the pusher, metres."""

_NEAREST, _FARTHEST = 0.06, 0.14
"""Range of distances in metres from where a cube starts to its goal position."""

_CLEARANCE = 0.012
_DRAWS = 200
_DONE = 0.005
"""Distance in metres at which a cube counts as placed: a third of the task's tolerance."""

_WALK, _PUSH = 0.055, 0.032
"""Speed in metres per frame without and with a cube."""

_CELL = 0.02
"""Grid spacing of the path search in metres."""

_STEPS = [(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]


def draw_places(
    table: PushSimulation, region: Region, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Goal positions of the cubes `[n, 2]` (at least one of them moves) and of the pushers.

    The first pusher is behind a cube that was moved, as after pushing it.
    """
    starts, edge = table.cube_pose[:, :2], table.cubes.edge
    behind, apart = edge / np.sqrt(2) + PUSHER_RADIUS + _CLEARANCE, 1.45 * edge
    pushers = table.pusher_position
    while True:
        places, moved = starts.copy(), list[int]()
        for cube in rng.permutation(len(starts)).tolist():
            others = np.vstack([np.delete(starts, cube, 0), np.delete(places, cube, 0)])
            for _ in range(_DRAWS):
                place = region.sample(rng)
                way = place - starts[cube]
                far = float(np.linalg.norm(way))
                begin = starts[cube] - way / max(far, 1e-9) * behind
                if not _NEAREST <= far <= _FARTHEST or np.abs(begin).max() > REACH:
                    continue
                if all(distance_to_line(other, begin, place) > apart for other in others):
                    places[cube] = place
                    moved.append(cube)
                    break
        if moved:
            last = moved[-1]
            way = places[last] - starts[last]
            pushers[0] = places[last] - way / np.linalg.norm(way) * behind
            return places, pushers


class Placer:
    """Pushes cubes one by one to their goal positions with the first pusher; other pushers rest.

    Args:
        table: the simulation, which it observes.
        places: `[n, 2]`, goal positions of the cubes in metres.
    """

    def __init__(self, table: PushSimulation, places: NDArray[np.float64]) -> None:
        self.table, self.places = table, places
        self.target = self.place
        self._resting = table.pusher_position[1:]
        self._steps, self._asked = self._live(), 0

    @property
    def place(self) -> Point:
        """The position of the pusher, [2] metres."""
        return self.table.pusher_position[0]

    def next_targets(self) -> NDArray[np.float64]:
        """Targets for the next frame, `[P, 2]` metres."""
        self.target = np.clip(next(self._steps), -REACH, REACH)
        self._asked += 1
        return np.vstack([self.target, self._resting])

    def _live(self) -> Iterator[Point]:
        while True:
            cube = self._next_cube()
            if cube is None:
                yield self.target
                continue
            behind, before = self._behind(cube), self._asked
            yield from self._walk(behind)
            yield from self._push(cube)
            if self._asked == before:  # no target was given: something blocks the way
                yield behind

    def _gap(self, cube: int) -> Point:
        return self.places[cube] - self.table.cube_pose[cube, :2]

    def _next_cube(self) -> int | None:
        """The cube, of those not in place, whose push starts nearest; None if all are in place."""
        waiting = [c for c in range(len(self.places)) if np.linalg.norm(self._gap(c)) > _DONE]
        return min(
            waiting, key=lambda c: np.linalg.norm(self._behind(c) - self.place), default=None
        )

    def _behind(self, cube: int) -> Point:
        """The position behind a cube where its push begins."""
        gap = self._gap(cube)
        away = self._contact * gap / max(float(np.linalg.norm(gap)), 1e-9)
        return np.clip(self.table.cube_pose[cube, :2] - away, -REACH, REACH)

    @property
    def _contact(self) -> float:
        """Distance between the centres of pusher and cube at which they cannot touch."""
        return self.table.cubes.edge / np.sqrt(2) + PUSHER_RADIUS + _CLEARANCE

    def _push(self, cube: int) -> Iterator[Point]:
        """Push towards the goal, staying behind the cube, until it arrives or slips away."""
        edge = self.table.cubes.edge
        while True:
            gap, here = self._gap(cube), self.place - self.table.cube_pose[cube, :2]
            far = float(np.linalg.norm(gap))
            ahead = gap / max(far, 1e-9)
            along = float(here @ ahead)
            side = here - along * ahead
            if far < _DONE or along > -0.4 * edge or np.linalg.norm(side) > 0.45 * edge:
                return
            free = max(0.0, -along - edge / np.sqrt(2) - PUSHER_RADIUS)
            yield self.place + (free + min(_PUSH, 0.6 * far + 0.002)) * ahead - 0.7 * side

    def _walk(self, goal: Point) -> Iterator[Point]:
        """Move to `goal` around cubes and other pushers."""
        centers = np.vstack([self.table.cube_pose[:, :2], self._resting])
        radii = np.full(len(centers), self._contact)
        radii[len(self.places) :] = 2 * PUSHER_RADIUS + _CLEARANCE
        for point in around(self.place, goal, centers, radii):
            while np.linalg.norm(point - self.target) > 1e-6:
                step = point - self.target
                yield self.target + step * min(1.0, _WALK / float(np.linalg.norm(step)))


def around(start: Point, goal: Point, centers: Point, radii: Point) -> list[Point]:
    """Corners of a short grid path (A*) that avoids discs; it leaves discs that it starts in."""
    line = np.linspace(-REACH, REACH, round(2 * REACH / _CELL) + 1)
    grid = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    depth = radii - np.linalg.norm(grid[:, :, None] - centers, axis=-1)
    cost = 1.0 + 40.0 * np.maximum(depth, 0).max(-1) / _CELL
    first, last = (tuple(np.rint((p + REACH) / _CELL).astype(int)) for p in (start, goal))
    came, spent, waiting = {first: first}, {first: 0.0}, [(0.0, first)]
    while waiting and (here := heapq.heappop(waiting)[1]) != last:
        for step in _STEPS:
            there = here[0] + step[0], here[1] + step[1]
            if not (0 <= there[0] < len(line) and 0 <= there[1] < len(line)):
                continue
            total = spent[here] + np.hypot(*step) * cost[there]
            if total < spent.get(there, np.inf):
                came[there], spent[there] = here, total
                heapq.heappush(waiting, (total + np.hypot(*np.subtract(last, there)), there))
    cells = [last]
    while cells[-1] != first:
        cells.append(came[cells[-1]])
    points = [grid[cell] for cell in cells[-2:0:-1]]
    return [*points, goal]
