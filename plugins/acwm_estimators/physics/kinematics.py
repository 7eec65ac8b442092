"""The physics of robot_arm and reacher."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from acwm_core.estimator import Constant, Gap, Observation, Physics, Reading, States
from acwm_estimators.physics.shapes import Array, distance, points_to_post

POSTS = ("obstacle_1", "obstacle_2", "obstacle_3", "obstacle_4")
GOALS = ("goal_1", "goal_2", "goal_3")

FIXED = {"upper arm": (1, 2), "forearm": (3, 4)}
"""Rows of robot_arm's `link_position` whose distance no joint changes, of the long links."""

REACHED = 0.02
"""Distance in metres at which robot_arm's hand is at a goal."""

LIMB_RADIUS = 0.045
"""How thin the arm is at its thinnest, metres: any place nearer to its axis is inside it."""

MARKER_RADIUS = 0.1
"""Of reacher's goal, metres."""


def robot_arm(limits: Mapping[str, float]) -> Physics:
    """A robot among posts, and goals in the air for its hand."""
    links = ("arm",) * 7 + ("gripper",)
    lengths = [
        Constant(
            f"length of the {name}",
            "length",
            partial(_link, *ends),
            limits[f"length of the {name}"],
        )
        for name, ends in FIXED.items()
    ]
    goals = [
        Gap("hand-goal", ("gripper", name), partial(_hand_to_goal, k), limits["hand-goal.touch"])
        for k, name in enumerate(GOALS)
    ]
    posts = [
        Gap("arm-post", ("arm", name), partial(_arm_to_post, k), solid=limits["arm-post.solid"])
        for k, name in enumerate(POSTS)
    ]
    return Physics(
        readings=(
            Reading("link_position", "position", links),
            Reading("hand_position", "position", ("gripper",)),
        ),
        objects=("arm", "gripper", *POSTS),
        lasting=int(limits["objects.lasting"]),
        unseen=limits["objects.unseen"],
        constants=tuple(lengths),
        gaps=(*goals, *posts),
    )


def reacher(limits: Mapping[str, float]) -> Physics:
    """An arm of two links in a plane and a flat marker."""
    return Physics(
        readings=(
            Reading("elbow_position", "position", ("upper_arm",)),
            Reading("fingertip_position", "position", ("fingertip",)),
            Reading("joint_angle", "angle", ("upper_arm", "forearm")),
        ),
        objects=("base", "upper_arm", "forearm", "fingertip", "goal"),
        lasting=int(limits["objects.lasting"]),
        unseen=limits["objects.unseen"],
        constants=(
            Constant(
                "length of the upper arm", "length", _upper_arm, limits["length of the upper arm"]
            ),
            Constant("length of the forearm", "length", _forearm, limits["length of the forearm"]),
        ),
        gaps=(Gap("tip-goal", ("fingertip", "goal"), _tip_to_goal, limits["tip-goal.touch"]),),
    )


def _link(first: int, second: int, seen: Observation, start: States) -> Array:
    links = np.asarray(seen.states["link_position"], np.float64)
    return distance(links[:, first], links[:, second])


def _hand_to_goal(k: int, seen: Observation, start: States) -> Array:
    hand = np.asarray(seen.states["hand_position"], np.float64)
    return distance(hand, np.asarray(start["goal_position"][k], np.float64)) - REACHED


def _arm_to_post(k: int, seen: Observation, start: States) -> Array:
    """From the axis of the arm, made as thick as its thinnest place, to a post."""
    links = np.asarray(seen.states["link_position"], np.float64)[:, 2:]
    hand = np.asarray(seen.states["hand_position"], np.float64)[:, None]
    joints = np.concatenate([links, hand], 1)
    between = [joints[:, :-1] + share * np.diff(joints, axis=1) for share in (0.0, 0.25, 0.5, 0.75)]
    there = 1.0 if start["obstacle_present"][k] > 0 else np.nan
    radius, height = (float(size) for size in start["obstacle_size"][k])
    points = np.concatenate(between, 1)
    place = np.asarray(start["obstacle_position"][k], np.float64) * there
    return points_to_post(points, place, radius, height) - LIMB_RADIUS


def _upper_arm(seen: Observation, start: States) -> Array:
    return np.linalg.norm(np.asarray(seen.states["elbow_position"], np.float64), axis=-1)


def _forearm(seen: Observation, start: States) -> Array:
    tip = np.asarray(seen.states["fingertip_position"], np.float64)
    return distance(tip, np.asarray(seen.states["elbow_position"], np.float64))


def _tip_to_goal(seen: Observation, start: States) -> Array:
    tip = np.asarray(seen.states["fingertip_position"], np.float64)
    return distance(tip, np.asarray(start["goal_position"], np.float64)) - MARKER_RADIUS
