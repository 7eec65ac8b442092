"""push_sand's task: push sand into a marked region. Does not import a simulator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task
from acwm_particle.physics import HEIGHT_EXTENT

if TYPE_CHECKING:
    from acwm_particle.push_sand import PushSand

RADIUS = 0.25
"""Radius of the region in metres."""

GAIN = 0.05
"""Least share of the sand that a goal moves into the region."""

MAKING = 55
"""Least number of frames of strokes for a goal, which is taken once the board is lifted."""

LIFTED = 0.2
"""Height in metres of the board's centre above which the board is above all sand."""

GRAIN, THROWN = 0.01, 0.1
"""Range of heights in metres that counts: below is about half a grain, above is thrown-up sand."""


class Gather(Task):
    """Push as much sand into a round region as lies there in the goal.

    The region, ``goal.state["region"]`` (x, y and radius in m), is beside the middle of the sand.
    The distance is the share of the sand that is missing in it. It is measured by the height map:
    volumes from 1 cm above the table to the top of the sand, at most 10 cm. While a board ploughs,
    this is wrong by 3 %, so success requires that the board is lifted. More sand than in the goal
    is equally good. Goals are states reached by strokes of the board.
    """

    name = "gather"
    summary = "as much sand in a marked region as in the goal, within 3 % of all sand"
    unit = ""
    tolerance = 0.03
    max_steps = 100

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """Draw a region, and push sand towards it."""
        from acwm_particle.sand_solution import Gatherer, draw_region

        env = cast("PushSand", environment)
        again = {"spec": environment.episode_spec}
        while True:
            region = draw_region(env.simulation, RADIUS, rng)
            start = Goal.now(environment)
            act = env.clipped(Gatherer(env.simulation, region, rng).next_action)
            frames = 0
            while frames < MAKING or env.simulation.board.position[2] < LIFTED:
                env.step(act())
                frames += 1
            goal = Goal.now(environment)
            goal = goal._replace(state={**goal.state, "region": region})
            if share_inside(goal.state, region) - share_inside(start.state, region) > GAIN:
                return goal
            environment.reset(options=again)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Share of the sand that is missing in the region."""
        region = goal.state["region"]
        wanted = share_inside(goal.state, region)
        return np.maximum(0.0, wanted - share_inside(seen.states, region))

    def success(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """Whether the sand is in the region and the board is lifted."""
        lifted = np.asarray(seen.states["board_position"], np.float64)[:, 2] > LIFTED
        return super().success(seen, goal) & lifted

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """Strokes towards the region that move the most sand from outside."""
        from acwm_particle.sand_solution import Gatherer

        env = cast("PushSand", environment)
        return env.clipped(Gatherer(env.simulation, goal.state["region"], rng).next_action)


def share_inside(
    states: Mapping[str, NDArray[Any]], region: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Share of the sand's volume `[…]` that is in a region (x, y, radius in m)."""
    heights = np.clip(np.asarray(states["sand_height"], np.float64), GRAIN, THROWN) - GRAIN
    (rows, columns), (deep, wide) = heights.shape[-2:], HEIGHT_EXTENT
    y = ((np.arange(rows) + 0.5) / rows * 2 - 1) * deep
    x = ((np.arange(columns) + 0.5) / columns * 2 - 1) * wide
    inside = np.hypot(x - region[0], y[:, None] - region[1]) <= region[2]
    return heights[..., inside].sum(-1) / np.maximum(heights.sum((-2, -1)), 1e-9)


GATHER = Gather()
