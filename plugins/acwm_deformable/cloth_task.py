"""cloth_move's tasks: the held edge to a line, the cloth over the sphere. Imports no simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import Environment, Policy
from acwm_core.estimator import Observation
from acwm_core.task import Goal, Task
from acwm_deformable.physics import CLOTH_ID

if TYPE_CHECKING:
    from acwm_deformable.cloth_move import ClothMove

RESTING = 6
"""Frames for which the cloth hangs still before a goal is taken."""


class Edge(Task):
    """Carry the cloth over the sphere until the edge that the grippers hold is at its line.

    The distance is the mean of the grippers' distances from the ends of the line.
    """

    name = "edge"
    summary = "the held edge of the cloth at a line beyond the sphere, its ends within 5 cm"
    unit = "m"
    tolerance = 0.05
    max_steps = 63

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """The edge beyond the sphere, 10 to 40 cm high, reached by carrying it there."""
        from acwm_deformable.cloth_solution import beyond

        env = cast("ClothMove", environment)
        act = self._carry(env, beyond(env.simulation, rng), rng)
        for _ in range(self.max_steps - 3 * RESTING):
            env.step(act())
        return Goal.now(environment)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Mean of both ends, m."""
        hands = np.asarray(seen.states["gripper_position"], np.float64)
        wanted = np.asarray(goal.state["gripper_position"], np.float64)
        return np.linalg.norm(hands - wanted, axis=-1).mean(-1)

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """Up, across the top of the sphere, and down."""
        middle = np.asarray(goal.state["gripper_position"], np.float64).mean(0)
        return self._carry(cast("ClothMove", environment), middle, rng)

    def _carry(
        self, env: ClothMove, middle: NDArray[np.float64], rng: np.random.Generator
    ) -> Policy:
        from acwm_deformable.cloth_solution import Bringer

        bringer = Bringer(env.simulation, env.longest_step, middle, rng)
        return lambda: bringer.next_steps()[0]


class Drape(Edge):
    """Lay the cloth over the sphere as it lies in the goal.

    The distance is that of the cloth's outlines in the picture: one minus their intersection over
    union. It depends on the camera, and on the size of frames a little.
    """

    name = "drape"
    summary = "the cloth over the sphere as in the goal: outlines overlap by 80 %"
    unit = ""
    tolerance = 0.2

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """One minus the intersection over union of the cloth's masks."""
        cloth, wanted = seen.masks == CLOTH_ID, goal.mask == CLOTH_ID
        shared, either = (cloth & wanted).sum((1, 2)), (cloth | wanted).sum((1, 2))
        return 1 - shared / np.maximum(either, 1)


EDGE, DRAPE = Edge(), Drape()
