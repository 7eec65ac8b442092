"""The scripted behaviour policy that collects cloth_move data."""

from collections.abc import Generator, Iterator

import numpy as np
from numpy.typing import NDArray

from acwm_deformable.cloth import GRASP_REACH, ROOM, Cloth

Steps = Iterator[None]

_LOW, _HIGH = np.transpose(ROOM)
_CALM = 0.008
"""Largest change in metres of the step from one frame to the next, as grippers have inertia."""


class Carrier:
    """Moves two grippers together: over the sphere, onto it, off it, past it and elsewhere.

    Args:
        cloth: the simulation, which it observes.
        longest: largest step along each axis in a frame, metres.
        rng: source of all its randomness.
    """

    def __init__(self, cloth: Cloth, longest: float, rng: np.random.Generator) -> None:
        self.cloth, self.longest, self.rng = cloth, longest, rng
        self.steps = np.zeros((2, 3))
        self.speed = 0.03
        self.size = float(np.ptp(cloth.nodes.reshape(-1, 3), axis=0).max())
        self._life = self.live()

    def next_steps(self) -> NDArray[np.float64]:
        """Steps of the grippers for the next frame, [2, 3] metres."""
        next(self._life)
        return np.clip(self.steps, -self.longest, self.longest)

    @property
    def middle(self) -> NDArray[np.float64]:
        """The point between the grippers, [3] metres."""
        return self.cloth.hands.mean(axis=0).astype(np.float64)

    def live(self) -> Steps:
        """Yield endlessly: first a motion at the sphere, then any motions."""
        if self.rng.random() < 0.4:
            yield from self.rest(int(self.rng.integers(1, 4)))
        first = True
        while True:
            self.speed = self.rng.uniform(0.026, 0.046)
            choice = self.rng.random() * (0.82 if first else 1.0)
            if choice < 0.34:
                yield from self.drag_over()
            elif choice < 0.60:
                yield from self.drape()
            elif choice < 0.76:
                yield from self.sweep()
            elif choice < 0.84:
                yield from self.lift_and_lower()
            elif choice < 0.94:
                yield from self.wander()
            else:
                yield from self.rest(int(self.rng.integers(3, 8)))
            first = False

    def drag_over(self) -> Steps:
        """Move across the top of the sphere to the far side, and mostly down there."""
        ahead = self._across_sphere(0.35)
        height = self._top + self.rng.uniform(0.05, 0.22)
        far = ahead * (self.cloth.sheet.sphere + self.rng.uniform(0.15, 0.40))
        yield from self.go(np.append(self.middle[:2], max(height, self.middle[2])), near=0.04)
        yield from self.go(np.append(far, height))
        if self.rng.random() < 0.7:
            yield from self.go(np.append(self.middle[:2], self.rng.uniform(0.08, 0.40)))

    def drape(self) -> Steps:
        """Lay the cloth on the sphere, wait, and pull it off to one side."""
        ahead = self._across_sphere(0.3)
        height = self._top + self.rng.uniform(0.12, 0.30)
        yield from self.go(np.append(self.middle[:2], max(height, self.middle[2])), near=0.05)
        beyond = ahead * self.size * self.rng.uniform(0.15, 0.5)
        yield from self.go(np.append(beyond, height))
        yield from self.go(np.append(beyond * 1.1, self.rng.uniform(0.15, 0.40)))
        yield from self.rest(int(self.rng.integers(1, 6)))
        turn = self.rng.normal(0, 1.0)
        if abs(turn) > 1.2:  # rise first, as low grippers would drag the hem against the sphere
            yield from self.go(np.append(self.middle[:2], height))
        angle = np.arctan2(ahead[1], ahead[0]) + turn
        away = np.array([np.cos(angle), np.sin(angle), self.rng.uniform(0.1, 0.8)])
        yield from self.go(self.middle + away * self.rng.uniform(0.3, 0.6))

    def sweep(self) -> Steps:
        """Move past the sphere or against it, with the cloth hanging as low as the sphere."""
        here = self.middle[:2] / (np.linalg.norm(self.middle[:2]) + 1e-9)
        side = np.array([-here[1], here[0]]) * self.rng.choice((-1.0, 1.0))
        height = self.rng.uniform(0.6, 1.05) * self.size
        start = here * self.rng.uniform(0.05, 0.3) - side * 0.35
        yield from self.go(np.append(start, height))
        yield from self.go(np.append(start + side * self.rng.uniform(0.5, 0.9), height))

    def lift_and_lower(self) -> Steps:
        """Move straight up and down."""
        low, high = self.rng.uniform(0.1, 0.45), self.rng.uniform(0.6, 0.9)
        heights = (high, low) if self.middle[2] < 0.6 else (low, high)
        for height in heights:
            yield from self.go(np.append(self.middle[:2], height))

    def wander(self) -> Steps:
        """Drift in slowly changing directions."""
        heading = self.rng.normal(0, 1, 3)
        for _ in range(int(self.rng.integers(8, 18))):
            heading += self.rng.normal(0, 0.35, 3) - 0.35 * self.middle * (1, 1, 0)
            self._follow(self.speed * heading / np.linalg.norm(heading))
            yield

    def rest(self, frames: int) -> Steps:
        """Slow down to a stop and stay there."""
        for _ in range(frames):
            self._follow(np.zeros(3))
            yield

    def go(self, goal: NDArray[np.float64], near: float = 0.02) -> Steps:
        """Move the middle of the grippers to `goal` ([3], metres), as far as there is room."""
        lean = self.cloth.hands - self.middle
        goal = np.clip(goal, (_LOW - lean).max(axis=0), (_HIGH - lean).min(axis=0))
        for _ in range(40):
            gap = goal - self.middle
            far = float(np.linalg.norm(gap))
            if far < near:
                return
            before = self.middle
            self._follow(gap / far * min(self.speed, 0.4 * far + 0.004))
            yield
            if np.linalg.norm(self.middle - before) < 0.25 * np.linalg.norm(self.steps[0]):
                return  # something is in the way

    def _follow(self, velocity: NDArray[np.float64]) -> None:
        """Change the steps of both grippers towards `velocity` (metres per frame)."""
        change = velocity - self.steps
        length = np.linalg.norm(change, axis=1, keepdims=True)
        self.steps = self.steps + change * np.minimum(1.0, _CALM / np.maximum(length, 1e-9))

    def _across_sphere(self, scatter: float) -> NDArray[np.float64]:
        """Direction [2] over the sphere to its other side."""
        angle = np.arctan2(-self.middle[1], -self.middle[0]) + self.rng.normal(0, scatter)
        return np.array([np.cos(angle), np.sin(angle)])

    @property
    def _top(self) -> float:
        return 2 * self.cloth.sheet.sphere


class TwoArms(Carrier):
    """Moves two independent grippers that can let go of the cloth.

    It does what `Carrier` does, and also rotates the pair, moves single arms, and drops and catches
    the cloth.
    """

    def __init__(self, cloth: Cloth, longest: float, rng: np.random.Generator) -> None:
        super().__init__(cloth, longest, rng)
        self.grasp = np.ones(2)
        self.extra = np.zeros((2, 3))

    def live(self) -> Steps:
        """Mix moves of both arms with moves of single arms, endlessly."""
        together = super().live()
        while True:
            for _ in range(int(self.rng.integers(8, 22))):
                next(together)
                yield
            self.speed = self.rng.uniform(0.024, 0.04)
            choice = self.rng.random()
            if self.cloth.held.min() < 0:
                for arm in np.flatnonzero(self.cloth.held < 0):
                    yield from self._catch(int(arm))
            elif choice < 0.30:
                yield from self.turn()
            elif choice < 0.55:
                yield from self.reach_out()
            else:
                yield from self.drop_and_catch()

    def turn(self) -> Steps:
        """Rotate the pair about the vertical and bring it closer together."""
        angle, squeeze = self.rng.uniform(-1.2, 1.2), self.rng.uniform(0.6, 1.0)
        c, s = np.cos(angle), np.sin(angle)
        lean = (self.cloth.hands - self.middle) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        yield from self._move_to(self.middle + lean * squeeze)

    def reach_out(self) -> Steps:
        """Move one arm while the other stays."""
        arm, goals = int(self.rng.integers(2)), self.cloth.hands.astype(np.float64)
        goals[arm] += self.rng.normal(0, 0.2, 3) - 0.2 * goals[arm] * (1, 1, 0)
        yield from self._move_to(goals)

    def drop_and_catch(self) -> Steps:
        """Release the cloth with one or both arms, back off, return and grasp it again."""
        arms = [0, 1] if self.rng.random() < 0.25 else [int(self.rng.integers(2))]
        self.grasp[arms] = -1.0
        goals = self.cloth.hands.astype(np.float64)
        goals[arms] += self.rng.uniform((-0.1, -0.1, 0.0), (0.1, 0.1, 0.12), (len(arms), 3))
        yield from self._move_to(goals, most=int(self.rng.integers(3, 7)))
        if self.rng.random() < 0.3:
            yield from self.reach_out()
        for arm in arms:
            yield from self._catch(arm)

    def _catch(self, arm: int) -> Generator[None]:
        """Go to the cloth's edge, away from what the other arm holds, and grasp it there."""
        self.speed = 0.05
        node = self._graspable(arm)
        for _ in range(25):
            goals = self.cloth.hands.astype(np.float64)
            goals[arm] = self.cloth.nodes[node]
            if np.linalg.norm(goals[arm] - self.cloth.hands[arm]) < 0.7 * GRASP_REACH:
                break
            self._pursue(goals)
            yield
        self.grasp[arm] = 1.0
        yield from self.rest(2)
        if self.cloth.held[arm] < 0:
            self.grasp[arm] = -1.0

    def _graspable(self, arm: int) -> int:
        """The nearest node on the rim of the cloth, at least half a side from any held node."""
        n = self.cloth.sheet.columns
        row, column = np.divmod(np.arange(n * n), n)
        rim = (row % (n - 1) == 0) | (column % (n - 1) == 0)
        for node in self.cloth.held[self.cloth.held >= 0]:
            rim &= np.hypot(row - node // n, column - node % n) >= n / 2
        away = np.linalg.norm(self.cloth.nodes - self.cloth.hands[arm], axis=1)
        return int(np.argmin(np.where(rim, away, np.inf)))

    def _move_to(self, goals: NDArray[np.float64], most: int = 14) -> Steps:
        """Move each gripper to its goal, [2, 3] metres."""
        goals = np.clip(goals, _LOW, _HIGH)
        for _ in range(most):
            if np.linalg.norm(goals - self.cloth.hands, axis=1).max() < 0.02:
                return
            self._pursue(goals)
            yield

    def _pursue(self, goals: NDArray[np.float64]) -> None:
        gap = goals - self.cloth.hands
        far = np.maximum(np.linalg.norm(gap, axis=1, keepdims=True), 1e-9)
        self._follow(gap / far * np.minimum(self.speed, 0.4 * far))
