"""The tasks: cover the goal's T, as in gym-pusht, or reach its pose, as in DINO-WM and others."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task

if TYPE_CHECKING:
    from acwm_pusht.pusht import PushT

PLACE = ((256.0, 256.0), np.pi / 4)
"""Where the arena shows the T's place: position and angle."""


class _OnPlace(Task):
    """A task whose own goals have the T on its place, and the disc beside it."""

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """The disc stays where it is, unless the T comes to lie there."""
        arena = cast("PushT", environment).arena
        arena.place(*PLACE)
        spot = np.array(arena.agent.position)
        while arena.gap(spot) < 20:
            spot = rng.uniform(50, 450, 2)
        arena.agent.position = spot.tolist()
        arena.space.reindex_shapes_for_body(arena.agent)
        return Goal.now(environment)


class Cover(_OnPlace):
    """Success as in gym-pusht: the T covers 95 % of where the goal has it."""

    name = "cover"
    summary = "the T covers 95 % of its place"
    unit = ""
    tolerance = 0.05
    max_steps = 300

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """The share of the goal's T that is bare, `[T]`; above 1 the farther, the more."""
        wanted = goal.state["corners"]
        bare = 1 - coverage(seen.states["corners"], wanted)
        far = np.linalg.norm(seen.states["corners"] - wanted, axis=-1).mean(-1) / 512
        return np.where(bare < 1 - 1e-9, bare.clip(0), 1 + far)


class Pose(_OnPlace):
    """Success as in DINO-WM and stable-worldmodel: T and disc are where the goal has them."""

    name = "pose"
    summary = "T and disc within 20 px of the goal together, and the T within 20° of its angle"
    unit = ""
    tolerance = 1.0
    max_steps = 300

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """The larger of both errors, in what is allowed of each, `[T]`."""
        moved = [seen.states[name] - goal.state[name] for name in ("agent", "block")]
        far = np.linalg.norm(np.concatenate(moved, -1), axis=-1)
        turn = seen.states["angle"] - goal.state["angle"]
        turn = np.abs((turn + np.pi) % (2 * np.pi) - np.pi)
        return np.maximum(far / 20, turn / (np.pi / 9))


def coverage(corners: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    """The share of a T `[8, 2]` that others `[T, 8, 2]` cover, `[T]`."""
    import shapely

    bars = shapely.polygons(corners.reshape(-1, 2, 1, 4, 2))
    goal = shapely.polygons(wanted.reshape(2, 4, 2))
    shared = shapely.area(shapely.intersection(bars, goal)).sum((1, 2))
    return shared / shapely.area(goal).sum()


COVER, POSE = Cover(), Pose()
