"""reacher's task: the fingertip at the marker. Does not import a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task

if TYPE_CHECKING:
    from acwm_kinematics.reacher import ReacherArm


class Reach(Task):
    """Bring the fingertip to the centre of the marker, at any speed.

    In the goal state the arm is at rest there, in the nearer of its two postures.
    """

    name = "reach"
    summary = "the fingertip within 5 cm of the marker's middle"
    unit = "m"
    tolerance = 0.05
    max_steps = 49
    # One frame does not show how fast the arm turns, but it rests at the start of an episode, from
    # which the model predicts where it is now.
    planning = ("cost=state", "past=2", "state_past=12")

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """Put the arm at rest with its fingertip at the marker."""
        env = cast("ReacherArm", environment)
        env.put(env.simulation.postures_for(env.simulation.goal)[0])
        return Goal.now(environment)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Distance of the fingertip from the marker in metres."""
        tip = np.asarray(seen.states["fingertip_position"], np.float64)
        wanted = np.asarray(goal.state["fingertip_position"], np.float64)
        return np.linalg.norm(tip - wanted, axis=-1)

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """The reach of the behaviour policy, repeated and without its noise."""
        return cast("ReacherArm", environment).reaching(rng)


REACH = Reach()
