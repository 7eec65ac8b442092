"""robot_arm's task: the hand at a goal without touching a post. Does not import a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task
from acwm_kinematics.physics import arm_to_post
from acwm_kinematics.states import POST_NAMES

if TYPE_CHECKING:
    from acwm_kinematics.robot_arm import RobotArm


class Reach(Task):
    """Bring the hand to one of the goals without touching a post.

    The goal is drawn at random; all goals look alike. An episode that touches a post has failed. In
    states, this is known only if a post is nearer to the axis of the arm than its thinnest part.
    """

    name = "reach"
    summary = "the hand within 3 cm of a goal, and no post touched"
    unit = "m"
    tolerance = 0.03
    max_steps = 63
    avoid = tuple((part, post) for post in POST_NAMES for part in ("arm", "gripper"))
    # One frame does not show how fast the arm moves. All frames are judged, because a post is
    # touched on the way.
    planning = ("cost=state", "cost.frames=null", "cost.failure=30", "past=2", "state_past=4")

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """Put the arm at rest with its hand at one of the goals."""
        env = cast("RobotArm", environment)
        env.put(env.layout.poses[rng.integers(len(env.layout.poses))])
        return Goal.now(environment)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Distance of the hand from the goal in metres."""
        hand = np.asarray(seen.states["hand_position"], np.float64)
        return np.linalg.norm(hand - np.asarray(goal.state["hand_position"], np.float64), axis=-1)

    def failed(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """Whether the arm is inside a post, even where it is thinnest."""
        depths = [arm_to_post(k, seen, goal.state) for k in range(len(POST_NAMES))]
        return np.any(np.stack(depths) < 0, axis=0)

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """Motions around the posts, planned in joint space."""
        hand = np.asarray(goal.state["hand_position"], np.float64)
        return cast("RobotArm", environment).reaching(hand, rng)


REACH = Reach()
