"""The physics of push_rope and cloth_move."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from acwm_core.physics import Constant, Gap, Observation, Physics, Reading, States
from acwm_estimators.physics.shapes import Array, distance, point_to_curve

POLE_RADIUS, ROPE_RADIUS = 0.07, 0.035
"""Metres; the rope's is that of nominal factors."""

HAND_RADIUS = 0.03
"""Of cloth_move's grippers, metres."""

TRACED = 20
"""Frames for which a rope must be read as too short: where it nearly touches itself it is misread
for some."""

GRIPPERS = ("gripper_1", "gripper_2")


def push_rope(limits: Mapping[str, float]) -> Physics:
    """A rope on a table and a pole."""
    return Physics(
        readings=(
            Reading("rope_position", "curve", ("rope",)),
            Reading("pole_position", "position", ("pole",)),
        ),
        objects=("rope", "pole"),
        shapes=("rope",),
        constants=(
            Constant("length of the rope", "length", _length, limits["length of the rope"]),
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
    return np.asarray(seen.states["rope_length"], np.float64)[:, 0]


def _pole_to_rope(seen: Observation, start: States) -> Array:
    rope = np.asarray(seen.states["rope_position"], np.float64)
    pole = np.asarray(seen.states["pole_position"], np.float64)
    return point_to_curve(pole, rope) - POLE_RADIUS - ROPE_RADIUS


def _radius(seen: Observation, start: States) -> Array:
    return np.asarray(seen.states["sphere_radius"], np.float64)


def _hand_to_sphere(k: int, seen: Observation, start: States) -> Array:
    hand = np.asarray(seen.states["gripper_position"][:, k], np.float64)
    sphere = np.asarray(start["sphere_position"], np.float64)
    return distance(hand, sphere) - float(start["sphere_radius"]) - HAND_RADIUS
