"""push_rope's task: push the rope into a given shape. Does not import a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task

if TYPE_CHECKING:
    from acwm_deformable.push_rope import PushRope

FRAMES = (20, 40)
"""Range of the number of frames that the behaviour policy acts before a goal is taken."""

FAR = 0.12
"""Least distance in metres of a goal from the start."""


class Shape(Task):
    """Push the rope to the shape and position that it has in the goal.

    The distance is the mean over the nodes, for the better order of the rope's ends. Goals are
    states that the behaviour policy reached from the same start. The position of the pole does not
    matter.
    """

    name = "shape"
    summary = "the rope in a given shape at a given place, nodes within 5 cm on average"
    unit = "m"
    tolerance = 0.05
    max_steps = 100
    # Where the pole ends does not matter, so the cost reads the rope. The pole has to go around it:
    # plans of 40 frames, of which 16 are taken before the next.
    planning = (
        *("planner.action_block=8", "planner.horizon=5", "planner.actions_per_plan=16"),
        *("planner.candidates=192", "planner.iterations=5", "planner.elites=15"),
        *("cost=state", "cost.frames=2"),
    )

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """The state after 2 to 4 seconds of the behaviour policy, or more if it is too near."""
        start, act = Goal.now(environment), environment.policy(rng)
        frames = int(rng.integers(*FRAMES))
        while True:
            for _ in range(frames):
                environment.step(act())
            goal = Goal.now(environment)
            if _apart(start.state["rope_position"], goal.state["rope_position"]) > FAR:
                return goal

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Mean distance of the nodes in metres."""
        return _apart(np.asarray(seen.states["rope_position"]), goal.state["rope_position"])

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """A series of pushes, each the best of many that were tried on copies of the rope."""
        from acwm_deformable.rope_solution import Shaper

        env, wanted = cast("PushRope", environment), goal.state["rope_position"]
        return Shaper(env.simulation, env.longest_step, wanted, rng).next_move


def _apart(nodes: NDArray[np.floating], wanted: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mean distance `[…]` of nodes `[…, N, 2]` from `[N, 2]`, for the better order of ends."""
    nodes = np.asarray(nodes, np.float64)
    both = [np.linalg.norm(nodes - each, axis=-1).mean(-1) for each in (wanted, wanted[::-1])]
    return np.minimum(*both)


SHAPE = Shape()
