"""The physical quantities of robot_arm and reacher. Does not import a simulator."""

from __future__ import annotations

from functools import partial

import numpy as np

from acwm_core.env.physics import Constant, Gap, Observation, Physics, States, readings_of
from acwm_kinematics.states import (
    ARM_CAMERA,
    GOAL_NAMES,
    POST_NAMES,
    REACHER_CAMERA,
    REACHER_STATE,
    ROBOT_ARM_STATE,
)
from acwm_sim.geometry import Array, distance, points_to_post

REACHED = 0.02
"""Distance in metres at which robot_arm's grasping point counts as at a goal."""

LIMB_RADIUS = 0.045
"""Radius of the arm where it is thinnest, metres: any point closer to its axis is inside it."""

MARKER_RADIUS = 0.1
"""Radius of reacher's goal marker, metres."""

_FIXED = {"upper arm": (1, 2), "forearm": (3, 4)}
"""Rows of robot_arm's `link_position` with a fixed distance, for the two long links."""


def _link(first: int, second: int, seen: Observation, start: States) -> Array:
    links = np.asarray(seen.states["link_position"], np.float64)
    return distance(links[:, first], links[:, second])


def _hand_to_goal(k: int, seen: Observation, start: States) -> Array:
    hand = np.asarray(seen.states["hand_position"], np.float64)
    return distance(hand, np.asarray(start["goal_position"][k], np.float64)) - REACHED


def axis_to_post(k: int, seen: Observation, start: States) -> Array:
    """Distance in metres from the axis of the arm to a post; NaN for a post that does not exist."""
    links = np.asarray(seen.states["link_position"], np.float64)[:, 2:]
    hand = np.asarray(seen.states["hand_position"], np.float64)[:, None]
    joints = np.concatenate([links, hand], 1)
    between = [joints[:, :-1] + share * np.diff(joints, axis=1) for share in (0.0, 0.25, 0.5, 0.75)]
    there = 1.0 if start["obstacle_present"][k] > 0 else np.nan
    radius, height = (float(size) for size in start["obstacle_size"][k])
    points = np.concatenate(between, 1)
    place = np.asarray(start["obstacle_position"][k], np.float64) * there
    return points_to_post(points, place, radius, height)


def arm_to_post(k: int, seen: Observation, start: States) -> Array:
    """Distance from the arm to a post, with the arm as thick as at its thinnest point."""
    return axis_to_post(k, seen, start) - LIMB_RADIUS


def _upper_arm(seen: Observation, start: States) -> Array:
    return np.linalg.norm(np.asarray(seen.states["elbow_position"], np.float64), axis=-1)


def _forearm(seen: Observation, start: States) -> Array:
    tip = np.asarray(seen.states["fingertip_position"], np.float64)
    return distance(tip, np.asarray(seen.states["elbow_position"], np.float64))


def _tip_to_goal(seen: Observation, start: States) -> Array:
    tip = np.asarray(seen.states["fingertip_position"], np.float64)
    return distance(tip, np.asarray(start["goal_position"], np.float64)) - MARKER_RADIUS


ROBOT_ARM = Physics(
    readings=readings_of(ROBOT_ARM_STATE, "link_position", "hand_position"),
    objects=("arm", "gripper", *POST_NAMES),
    constants=tuple(
        Constant(f"length of the {name}", "length", partial(_link, *ends))
        for name, ends in _FIXED.items()
    ),
    gaps=(
        *(
            Gap("hand-goal", ("gripper", name), partial(_hand_to_goal, k), touch=0.0)
            for k, name in enumerate(GOAL_NAMES)
        ),
        *(
            Gap("arm-post", ("arm", name), partial(arm_to_post, k), solid=0.0)
            for k, name in enumerate(POST_NAMES)
        ),
    ),
    camera=ARM_CAMERA,
    state=ROBOT_ARM_STATE,
)
"""The physics of a robot among posts, with goals in the air for its hand."""

REACHER = Physics(
    readings=readings_of(REACHER_STATE, "elbow_position", "fingertip_position", "joint_angle"),
    objects=("base", "upper_arm", "forearm", "fingertip", "goal"),
    constants=(
        Constant("length of the upper arm", "length", _upper_arm),
        Constant("length of the forearm", "length", _forearm),
    ),
    gaps=(Gap("tip-goal", ("fingertip", "goal"), _tip_to_goal, touch=0.0),),
    camera=REACHER_CAMERA,
    state=REACHER_STATE,
)
"""The physics of a two-link arm in a plane and a flat marker."""
