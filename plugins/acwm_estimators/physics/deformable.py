"""The physics of push_rope and cloth_move."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from acwm_core.estimator import Constant, Gap, Observation, Physics, Reading, States
from acwm_estimators.physics.shapes import Array, distance, outer_radius, point_to_curve
from acwm_estimators.worlds import LAYOUTS

POLE_RADIUS, ROPE_RADIUS = 0.07, 0.035
"""Metres; the rope's is that of nominal factors."""

HAND_RADIUS = 0.03
"""Of cloth_move's grippers, metres."""

CLOTH_CAMERA, ROPE_CAMERA = (LAYOUTS[name].camera for name in ("cloth_move", "push_rope"))

ROPE_ID, SPHERE_ID = 1, 1

COVERED = 30
"""Frames for which a rope must be too short: the pole and the rope itself may cover parts."""

GRIPPERS = ("gripper_1", "gripper_2")


def push_rope(limits: Mapping[str, float]) -> Physics:
    """A rope on a table and a pole."""
    return Physics(
        readings=(
            Reading("rope_position", "curve", ("rope",)),
            Reading("pole_position", "position", ("pole",)),
        ),
        objects=("rope", "pole"),
        lasting=int(limits["objects.lasting"]),
        unseen=limits["objects.unseen"],
        shapes=("rope",),
        constants=(
            Constant(
                "length of the rope", "length", _length, limits["length of the rope"], COVERED
            ),
        ),
        gaps=(
            Gap(
                "rope-pole",
                ("rope", "pole"),
                _pole_to_rope,
                limits["rope-pole.touch"],
                limits["rope-pole.solid"],
            ),
        ),
    )


def cloth_move(limits: Mapping[str, float]) -> Physics:
    """A cloth that two grippers carry, and a sphere."""
    return Physics(
        readings=(Reading("gripper_position", "position", GRIPPERS),),
        objects=("sphere", "cloth"),  # grippers hang on wires thinner than a pixel
        lasting=int(limits["objects.lasting"]),
        unseen=limits["objects.unseen"],
        shapes=("cloth",),
        constants=(
            Constant("radius of the sphere", "length", _radius, limits["radius of the sphere"]),
        ),
        gaps=tuple(
            Gap(
                "sphere-gripper",
                ("sphere", name),
                partial(_hand_to_sphere, k),
                limits["sphere-gripper.touch"],
                limits["sphere-gripper.solid"],
            )
            for k, name in enumerate(GRIPPERS)
        ),
    )


def _length(seen: Observation, start: States) -> Array:
    """The length in m of as much rope as there are pixels of it.

    A trace of the rope is misled where it lies beside itself; its area is not.
    """
    masks, camera = seen.masks == ROPE_ID, ROPE_CAMERA
    height, (_, down, forward) = masks.shape[1], camera.rotation
    rows = (np.arange(height) + 0.5) / height - 0.5
    rays = forward + rows[:, None] / camera.focal * down
    depth = (ROPE_RADIUS - camera.eye[2]) / rays[:, 2]
    # A pixel of the table that is seen at a slant covers more of it than its width squared.
    area = (depth / camera.focal / height) ** 2 / np.abs(forward[2])
    return (masks.sum(2) * area).sum(1) / (2 * ROPE_RADIUS)


def _pole_to_rope(seen: Observation, start: States) -> Array:
    rope = np.asarray(seen.states["rope_position"], np.float64)
    pole = np.asarray(seen.states["pole_position"], np.float64)
    return point_to_curve(pole, rope) - POLE_RADIUS - ROPE_RADIUS


def _radius(seen: Observation, start: States) -> Array:
    """Of the sphere's outline in heights of the frame, where neither cloth nor hand covers it."""
    middle = CLOTH_CAMERA.project(np.asarray(start["sphere_position"], np.float64))[:2]
    return outer_radius(seen.masks, SPHERE_ID, middle)


def _hand_to_sphere(k: int, seen: Observation, start: States) -> Array:
    hand = np.asarray(seen.states["gripper_position"][:, k], np.float64)
    sphere = np.asarray(start["sphere_position"], np.float64)
    return distance(hand, sphere) - float(start["sphere_radius"]) - HAND_RADIUS
