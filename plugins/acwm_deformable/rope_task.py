"""push_rope's task: the rope to a given shape. Imports no simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import Environment, Policy
from acwm_core.estimator import Observation
from acwm_core.planning.task import Goal, Task

if TYPE_CHECKING:
    from acwm_deformable.push_rope import PushRope

FRAMES = (20, 40)
"""After how many frames of the behaviour a goal is taken."""

FAR = 0.12
"""Distance in metres that a goal has from the start at least."""


class Shape(Task):
    """Push the rope into the shape and to the place that it has in the goal.

    The distance is the mean over the nodes, whichever end comes first. Goals are states that the
    behaviour reached from the same start. Where the pole is does not matter.
    """

    name = "shape"
    summary = "the rope in a given shape at a given place, nodes within 5 cm on average"
    unit = "m"
    tolerance = 0.05
    max_steps = 100

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """What the behaviour makes of the rope in 2 to 4 seconds."""
        start, act = Goal.now(environment), environment.policy(rng)
        frames = int(rng.integers(*FRAMES))
        while True:
            for _ in range(frames):
                environment.step(act())
            goal = Goal.now(environment)
            if _apart(start.state["rope_position"], goal.state["rope_position"]) > FAR:
                return goal

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Mean distance of the nodes, m."""
        return _apart(np.asarray(seen.states["rope_position"]), goal.state["rope_position"])

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """Push after push, each the best of many that were tried on copies of the rope."""
        from acwm_deformable.rope_solution import Shaper

        env, wanted = cast("PushRope", environment), goal.state["rope_position"]
        return Shaper(env.simulation, env.longest_step, wanted, rng).next_move


def _apart(nodes: NDArray[np.floating], wanted: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean distance `[…]` of nodes `[…, N, 2]` from wanted ones `[N, 2]`, from either end."""
    nodes = np.asarray(nodes, np.float64)
    both = [np.linalg.norm(nodes - each, axis=-1).mean(-1) for each in (wanted, wanted[::-1])]
    return np.minimum(*both)


SHAPE = Shape()
