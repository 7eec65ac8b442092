"""cloth_move's task: move the held edge to a line. Does not import a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task

if TYPE_CHECKING:
    from acwm_deformable.cloth_move import ClothMove

RESTING = 6
"""Goals are taken after `max_steps - 3 * RESTING` frames, when the cloth hangs still."""


class Edge(Task):
    """Carry the cloth over the sphere until the edge held by the grippers is at a line.

    The distance is the mean of the grippers' distances from the ends of the line.
    """

    name = "edge"
    summary = "the held edge of the cloth at a line beyond the sphere, its ends within 5 cm"
    unit = "m"
    tolerance = 0.05
    max_steps = 63
    # A picture hardly shows how far away the edge is, and most of it is cloth.
    planning = ("cost=state", "past=2", "planner.candidates=256")

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """Draw a goal beyond the sphere and carry the edge there."""
        from acwm_deformable.cloth_solution import beyond

        env = cast("ClothMove", environment)
        act = self._carry(env, beyond(env.simulation, rng), rng)
        for _ in range(self.max_steps - 3 * RESTING):
            env.step(act())
        return Goal.now(environment)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Mean distance of both ends of the edge in metres."""
        hands = np.asarray(seen.states["gripper_position"], np.float64)
        wanted = np.asarray(goal.state["gripper_position"], np.float64)
        return np.linalg.norm(hands - wanted, axis=-1).mean(-1)

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """Move up, across the top of the sphere, and down."""
        middle = np.asarray(goal.state["gripper_position"], np.float64).mean(0)
        return self._carry(cast("ClothMove", environment), middle, rng)

    def _carry(
        self, env: ClothMove, middle: NDArray[np.float64], rng: np.random.Generator
    ) -> Policy:
        from acwm_deformable.cloth_solution import Bringer

        bringer = Bringer(env.simulation, env.longest_step, middle, rng)
        return lambda: bringer.next_steps()[0]


EDGE = Edge()
