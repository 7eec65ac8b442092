"""pour_water's task: fill the container to a level. Does not import a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task

if TYPE_CHECKING:
    from acwm_particle.pour_water import PourWater

SPILT = 0.02
"""Share of the water on the table above which water counts as spilt; single drops do not."""

FALLING = 0.01
"""Largest share of the water in the air after pouring."""


class Fill(Task):
    """Fill the container to the level of the goal, within 5 % of it, and spill nothing.

    The distance is the difference of the levels, relative to the goal's level. Success requires
    that no water is in the air, so a level that is just passed while pouring does not count. Goals
    are levels of 30 to 80 % of the water.
    """

    name = "fill"
    summary = "the container filled to a level, within 5 % of it, and nothing spilt"
    unit = ""
    tolerance = 0.05
    max_steps = 120
    # Spilling counts for more than the whole distance, which is 20 tolerances. The cup rests at the
    # start, from which the model predicts where it is now; a picture while it pours does not show
    # how it moves.
    planning = (
        *("cost=state", "cost.failure=100", "past=2", "state_past=30"),
        *("planner.action_block=8", "planner.horizon=6"),
        *("planner.candidates=160", "planner.iterations=4"),
    )

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """Put a part of the water at rest into the container; the rest stays in the cup."""
        share = float(rng.uniform(0.3, 0.8))
        cast("PourWater", environment).simulation.fill_container(share, rng)
        return Goal.now(environment)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Difference of the level from the goal's level, as a share of the latter."""
        level = np.asarray(seen.states["water_share"], np.float64)[:, 1]
        return np.abs(level / float(goal.state["water_share"][1]) - 1)

    def failed(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """Whether more than single drops are on the table."""
        return np.asarray(seen.states["water_share"], np.float64)[:, 2] > SPILT

    def success(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """Whether the container is filled and no water is falling."""
        falling = 1 - np.asarray(seen.states["water_share"], np.float64).sum(-1)
        return super().success(seen, goal) & (falling <= FALLING)

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """Pour until enough has left the cup, tilt back, and pour more if some is missing."""
        from acwm_particle.water_solution import Filler

        env, share = cast("PourWater", environment), float(goal.state["water_share"][1])
        return env.clipped(Filler(env.simulation, share, rng).next_action)


FILL = Fill()
