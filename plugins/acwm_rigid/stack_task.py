"""stack_cube's task: red on green. Does not import a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task

if TYPE_CHECKING:
    from acwm_rigid.stack_cube import StackCube

GONE = 0.05
"""Distance in metres between hand and red cube at which the hand no longer holds the cube."""


class Stack(Task):
    """Put the red cube onto the green one and take the hand away.

    The distance is that of the red cube's centre from its place above the green one, wherever the
    green cube is. So it says nothing about the hand before the hand moves a cube.
    """

    name = "stack"
    summary = "red on green, within 2 cm, and the hand gone from it"
    unit = "m"
    tolerance = 0.02
    max_steps = 70

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """The red cube square on the green one, with the hand above both."""
        cast("StackCube", environment).put_stacked()
        return Goal.now(environment)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Distance of the red cube from its place on the green one in metres."""
        cubes = np.asarray(seen.states["cube_position"], np.float64)
        red, green = np.asarray(goal.state["cube_position"], np.float64)
        return np.linalg.norm((cubes[:, 0] - cubes[:, 1]) - (red - green), axis=-1)

    def success(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """Whether the red cube is in its place and the hand does not hold it."""
        hand = np.asarray(seen.states["hand_position"], np.float64)
        red = np.asarray(seen.states["cube_position"], np.float64)[:, 0]
        return super().success(seen, goal) & (np.linalg.norm(hand - red, axis=-1) > GONE)

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """The behaviour policy, which solves this task."""
        return environment.policy(rng)


STACK = Stack()
