"""The physical quantities of push_sand and pour_water. Does not import a simulator."""

from __future__ import annotations

import numpy as np

from acwm_core.env.physics import (
    Constant,
    Gap,
    Level,
    Observation,
    Physics,
    States,
    readings_of,
)
from acwm_particle.cup import THICKNESS, Vessel
from acwm_particle.states import POUR_WATER_STATE, PUSH_SAND_STATE, SAND_CAMERA, WATER_CAMERA
from acwm_sim.geometry import Array, axes_of_quaternion, points_to_post

BOARD = (0.010, 0.15, 0.075)
"""Half sizes of push_sand's board with nominal factors: thickness, width and height in metres."""

HEIGHT_EXTENT = (0.48, 0.80)
"""Half sizes of push_sand's height map along y and x, metres."""

CUP, CONTAINER = Vessel(inner=0.46, tall=1.2), Vessel(inner=0.68, tall=0.8)
"""The vessels of pour_water; the container's radius is the one for nominal factors."""

SPACING = 0.06
"""Distance in metres between particles of water at rest; each represents a cube of this side."""

SETTLED = 30
"""Frames for which less sand or water must be seen, as streams and splashes are misread briefly."""

_PARTICLE = SPACING**3  # m³


def _grains(seen: Observation, start: States) -> Array:
    return np.asarray(seen.states["grain_count"], np.float64)[:, 0]


def _sand_heights(seen: Observation, start: States) -> Array:
    heights = np.asarray(seen.states["sand_height"], np.float64)
    return heights.reshape(len(heights), -1)


def _board_to_sand(seen: Observation, start: States) -> Array:
    """Smallest height of the board's lower edge above the sand."""
    middle = np.asarray(seen.states["board_position"], np.float64)
    axes = axes_of_quaternion(np.asarray(seen.states["board_quaternion"], np.float64))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in np.linspace(-1, 1, 9) for z in (-1, 1)])
    points = middle[:, None] + np.einsum("pa,tad->tpd", corners * BOARD, axes)
    heights = np.asarray(seen.states["sand_height"], np.float64)
    _, rows, columns = heights.shape
    deep, wide = HEIGHT_EXTENT
    row = ((np.nan_to_num(points[..., 1]) + deep) / (2 * deep) * rows).astype(int)
    column = ((np.nan_to_num(points[..., 0]) + wide) / (2 * wide) * columns).astype(int)
    frame = np.arange(len(points))[:, None]
    below = heights[frame, np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
    return (points[..., 2] - below).min(-1)


def _water(seen: Observation, start: States) -> Array:
    return np.asarray(seen.states["water_count"], np.float64)[:, 0]


def _water_level(seen: Observation, start: States) -> Array:
    """The level in m of the water seen in the container, if it were at rest."""
    amount = _water(seen, start) * np.asarray(seen.states["water_share"][:, 1], np.float64)
    return amount[:, None] * _PARTICLE / (np.pi * CONTAINER.inner**2)


def _depth(seen: Observation, start: States, share: int, area: float) -> Array:
    """The level in m of a share of the true amount of water on an area."""
    volume = float(start["water_count"][0]) * _PARTICLE
    return np.asarray(seen.states["water_share"][:, share], np.float64) * volume / area


def _water_in_container(seen: Observation, start: States) -> Array:
    return -_depth(seen, start, 1, np.pi * CONTAINER.inner**2)


def _water_on_table(seen: Observation, start: States) -> Array:
    return -_depth(seen, start, 2, 1.0)


def _cup_to_container(seen: Observation, start: States) -> Array:
    """Distance from the outside of the cup to the container, which is solid up to its rim."""
    pose = np.asarray(seen.states["cup_pose"], np.float64)
    c, s = np.cos(pose[:, 3]), np.sin(pose[:, 3])
    x, y, z = CUP.outline.T
    turned = [c[:, None] * x + s[:, None] * z, np.broadcast_to(y, (len(c), len(y)))]
    turned.append(c[:, None] * z - s[:, None] * x)
    points = np.stack(turned, -1) + pose[:, None, :3]
    rim = CONTAINER.tall + THICKNESS
    return points_to_post(points, start["container_position"], CONTAINER.outer, rim)


PUSH_SAND = Physics(
    readings=readings_of(PUSH_SAND_STATE, "board_position", "board_quaternion"),
    objects=("board",),
    shapes=("sand",),
    levels=(Level("sand", _sand_heights),),
    constants=(Constant("amount of sand", "amount", _grains, lasting=SETTLED),),
    gaps=(Gap("sand-board", ("sand", "board"), _board_to_sand, touch=0.0),),
    camera=SAND_CAMERA,
    state=PUSH_SAND_STATE,
)
"""The physics of sand and a board."""

POUR_WATER = Physics(
    readings=readings_of(POUR_WATER_STATE, "cup_pose", "container_position"),
    objects=("cup", "container", "holder"),
    shapes=("water",),
    levels=(Level("water in the container", _water_level),),
    constants=(Constant("amount of water", "amount", _water, lasting=SETTLED),),
    gaps=(
        Gap("cup-container", ("cup", "container"), _cup_to_container, touch=0.0, solid=0.0),
        Gap("container-water", ("container", "water"), _water_in_container, touch=0.0),
        Gap("table-water", ("table", "water"), _water_on_table, touch=0.0),
    ),
    camera=WATER_CAMERA,
    state=POUR_WATER_STATE,
)
"""The physics of water, a cup and a container."""
