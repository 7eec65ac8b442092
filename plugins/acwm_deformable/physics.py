"""The physical quantities of push_rope and cloth_move. Does not import a simulator."""

from __future__ import annotations

from functools import partial

import numpy as np

from acwm_core.env.physics import Constant, Gap, Observation, Physics, States, readings_of
from acwm_deformable.states import (
    CLOTH_CAMERA,
    CLOTH_MOVE_STATE,
    GRIPPERS,
    PUSH_ROPE_STATE,
    ROPE_CAMERA,
    ROPE_RADIUS,
)
from acwm_sim.geometry import Array, distance, outer_radius, point_to_curve

POLE_RADIUS = 0.07  # metres

HAND_RADIUS = 0.03
"""Radius of a gripper of cloth_move, metres."""

ROPE_ID, SPHERE_ID = 1, 1
"""Instance ids of push_rope's rope and cloth_move's sphere."""

COVERED = 30
"""Frames for which a rope must be too short, as the pole and the rope itself may cover parts."""


def _length(seen: Observation, start: States) -> Array:
    """The length of the rope in metres, from the area of its pixels.

    The area stays reliable where the rope touches itself, but tracing fails there.
    """
    masks, camera = seen.masks == ROPE_ID, ROPE_CAMERA
    height, forward = masks.shape[1], camera.axes[2]
    rows = (np.arange(height) + 0.5) / height - 0.5
    table = camera.on_plane(np.stack([np.zeros(height), rows], -1), ROPE_RADIUS)
    depth = camera.to_frame(table)[:, 2]
    # Seen at an angle, a pixel covers more of the table than its width squared.
    area = (depth / camera.focal(height)) ** 2 / np.abs(forward[2])
    return (masks.sum(2) * area).sum(1) / (2 * ROPE_RADIUS)


def _pole_to_rope(seen: Observation, start: States) -> Array:
    rope = np.asarray(seen.states["rope_position"], np.float64)
    pole = np.asarray(seen.states["pole_position"], np.float64)
    return point_to_curve(pole, rope) - POLE_RADIUS - ROPE_RADIUS


def _radius(seen: Observation, start: States) -> Array:
    """Radius of the sphere's outline in frame heights, where neither cloth nor hand covers it."""
    middle = CLOTH_CAMERA.to_frame(np.asarray(start["sphere_position"], np.float64))[:2]
    return outer_radius(seen.masks, SPHERE_ID, middle)


def _hand_to_sphere(k: int, seen: Observation, start: States) -> Array:
    hand = np.asarray(seen.states["gripper_position"][:, k], np.float64)
    sphere = np.asarray(start["sphere_position"], np.float64)
    return distance(hand, sphere) - float(start["sphere_radius"]) - HAND_RADIUS


PUSH_ROPE = Physics(
    readings=readings_of(PUSH_ROPE_STATE, "rope_position", "pole_position"),
    objects=("rope", "pole"),
    shapes=("rope",),
    constants=(Constant("length of the rope", "length", _length, lasting=COVERED),),
    gaps=(Gap("rope-pole", ("rope", "pole"), _pole_to_rope, touch=0.0, solid=0.0),),
    camera=ROPE_CAMERA,
    state=PUSH_ROPE_STATE,
)
"""The physics of a rope on a table and a pole."""

CLOTH_MOVE = Physics(
    readings=readings_of(CLOTH_MOVE_STATE, "gripper_position"),
    objects=("sphere", "cloth"),  # grippers hang on wires thinner than a pixel
    shapes=("cloth",),
    constants=(Constant("radius of the sphere", "length", _radius),),
    gaps=tuple(
        Gap("sphere-gripper", ("sphere", name), partial(_hand_to_sphere, k), touch=0.0, solid=0.0)
        for k, name in enumerate(GRIPPERS)
    ),
    camera=CLOTH_CAMERA,
    state=CLOTH_MOVE_STATE,
)
"""The physics of a cloth carried by two grippers, and a sphere."""
