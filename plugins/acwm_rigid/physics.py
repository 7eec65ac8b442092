"""The physical quantities of push_cube and stack_cube. Does not import a simulator."""

from __future__ import annotations

from functools import partial
from itertools import combinations

import numpy as np

from acwm_core.env.physics import Gap, Observation, Physics, States, readings_of
from acwm_rigid.states import (
    CUBES,
    PAIR,
    STACK_CAMERA,
    STACK_CUBE_STATE,
    TABLE_CAMERA,
    push_cube_state,
)
from acwm_sim.geometry import (
    Array,
    axes_of,
    axes_of_quaternion,
    box_to_box,
    disc_to_box,
    distance,
)

INNER = 0.30
"""Half width of push_cube's table between its walls, metres."""

PUSHER_RADIUS = 0.03


def _push_cube(pushers: tuple[str, ...]) -> Physics:
    """The physics of cubes that slide on a table, and of the pushers."""
    state = push_cube_state(pushers)
    touched = [
        ("pusher-cube", (pusher, cube), partial(_pusher_to_cube, k, slot))
        for k, pusher in enumerate(pushers)
        for slot, cube in enumerate(CUBES)
    ]
    touched += [
        ("cube-cube", (CUBES[a], CUBES[b]), partial(_cube_to_cube, a, b))
        for a, b in combinations(range(len(CUBES)), 2)
    ]
    touched += [
        ("wall-cube", ("wall", cube), partial(_cube_to_wall, slot))
        for slot, cube in enumerate(CUBES)
    ]
    return Physics(
        readings=readings_of(state, "pusher_position", "cube_position", "cube_yaw"),
        objects=(*pushers, *CUBES),
        gaps=tuple(Gap(*each, touch=0.0, solid=0.0) for each in touched),
        camera=TABLE_CAMERA,
        state=state,
    )


def _cube(slot: int, seen: Observation, start: States) -> tuple[Array, Array, Array]:
    """Centres `[T, 2]`, axes `[T, 2, 2]` and half the edge of a cube on the table.

    The edge is twice the height of the centre in the first frame. For a cube that does not exist,
    centres and half edge are NaN.
    """
    there = 1.0 if start["cube_present"][slot] > 0 else np.nan
    position = np.asarray(seen.states["cube_position"][:, slot, :2], np.float64)
    yaw = np.asarray(seen.states["cube_yaw"][:, slot], np.float64)
    return position * there, axes_of(yaw), np.asarray(start["cube_position"][slot, 2] * there)


def _pusher_to_cube(k: int, slot: int, seen: Observation, start: States) -> Array:
    pusher = np.asarray(seen.states["pusher_position"][:, k], np.float64)
    return disc_to_box(pusher, PUSHER_RADIUS, *_cube(slot, seen, start))


def _cube_to_cube(a: int, b: int, seen: Observation, start: States) -> Array:
    middles, axes, halves = zip(_cube(a, seen, start), _cube(b, seen, start), strict=True)
    return box_to_box(middles, axes, halves)


def _cube_to_wall(slot: int, seen: Observation, start: States) -> Array:
    middle, axes, half = _cube(slot, seen, start)
    return INNER - (np.abs(middle) + np.abs(axes).sum(-2) * half).max(-1)


def _half_edge(start: States) -> float:
    """Half the edge of stack_cube's equally large cubes: the height of the one on the floor."""
    return float(start["cube_position"][:, 2].min())


def _red_to_green(seen: Observation, start: States) -> Array:
    position = np.asarray(seen.states["cube_position"], np.float64)
    axes = axes_of_quaternion(np.asarray(seen.states["cube_quaternion"], np.float64))
    half = np.full(3, _half_edge(start))
    return box_to_box((position[:, 0], position[:, 1]), (axes[:, 0], axes[:, 1]), (half, half))


def _red_to_floor(seen: Observation, start: States) -> Array:
    axes = axes_of_quaternion(np.asarray(seen.states["cube_quaternion"][:, 0], np.float64))
    down = np.abs(axes[..., 2]).sum(-1) * _half_edge(start)
    return np.asarray(seen.states["cube_position"][:, 0, 2], np.float64) - down


def _grip_on_red(seen: Observation, start: States) -> Array:
    """Distance of the fingers from closing on the red cube, which must be between them."""
    hand = np.asarray(seen.states["hand_position"], np.float64)
    cube = np.asarray(seen.states["cube_position"][:, 0], np.float64)
    half = _half_edge(start)
    opening = np.asarray(seen.states["gripper_opening"], np.float64).reshape(len(hand))
    return np.maximum(opening / 2 - half, distance(hand, cube) - half)


PUSH_CUBE = _push_cube(("pusher",))
PUSH_CUBE_TWO_PUSHERS = _push_cube(("pusher_1", "pusher_2"))

STACK_CUBE = Physics(
    readings=readings_of(STACK_CUBE_STATE, "hand_position", "cube_position", "cube_quaternion"),
    objects=("arm", "gripper", *PAIR),
    gaps=(
        Gap("cube-cube", PAIR, _red_to_green, touch=0.0, solid=0.0),
        Gap("floor-cube", ("floor", "red_cube"), _red_to_floor, touch=0.0, solid=0.0),
        Gap("grip", ("gripper", "red_cube"), _grip_on_red, touch=0.0),
    ),
    camera=STACK_CAMERA,
    state=STACK_CUBE_STATE,
)
"""The physics of two cubes and the hand of a robot."""
