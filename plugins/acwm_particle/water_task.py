"""pour_water's task: the container filled to a level. Imports no simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import Environment, Policy
from acwm_core.estimator import Observation
from acwm_core.planning.task import Goal, Task

if TYPE_CHECKING:
    from acwm_particle.pour_water import PourWater

SPILT = 0.02
"""Share of the water on the table that counts as spilt: single drops do not."""

FALLING = 0.01
"""Share of the water in the air at most, when pouring is over."""


class Fill(Task):
    """Fill the container to the level of the goal, within 5 % of it, and spill nothing.

    The distance is that of the levels, relative to the goal's. Success waits until nothing is in
    the air; so a stream that passes the level has not reached it. Levels are those of 30 to 80 % of
    the water.
    """

    name = "fill"
    summary = "the container filled to a level, within 5 % of it, and nothing spilt"
    unit = ""
    tolerance = 0.05
    max_steps = 120

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """A part of the water at rest in the container, the rest in the cup where it began."""
        share = float(rng.uniform(0.3, 0.8))
        cast("PourWater", environment).simulation.fill_container(share, rng)
        return Goal.now(environment)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Of the level from the goal's, as a share of the goal's."""
        level = np.asarray(seen.states["water_share"], np.float64)[:, 1]
        return np.abs(level / float(goal.state["water_share"][1]) - 1)

    def failed(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """More than single drops are on the table."""
        return np.asarray(seen.states["water_share"], np.float64)[:, 2] > SPILT

    def success(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """It is filled, and nothing falls any more."""
        falling = 1 - np.asarray(seen.states["water_share"], np.float64).sum(-1)
        return super().success(seen, goal) & (falling <= FALLING)

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """Pour until enough has left the cup, tilt back, and pour the rest if some is missing."""
        from acwm_particle.water_solution import Filler

        env, share = cast("PourWater", environment), float(goal.state["water_share"][1])
        return env.clipped(Filler(env.simulation, share, rng).next_action)


FILL = Fill()
