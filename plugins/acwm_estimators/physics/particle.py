"""The physics of push_sand and pour_water."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from acwm_core.estimator import Constant, Gap, Level, Observation, Physics, Reading, States
from acwm_estimators.physics.shapes import Array, axes_of_quaternion, points_to_post

BOARD = (0.010, 0.15, 0.075)
"""Half sizes of push_sand's board at nominal factors: thickness, width and height in metres."""

SAND_EXTENT = (0.48, 0.80)
"""Half sizes of push_sand's height map along y and x, metres."""

CUP = (0.49, 1.2, 0.03)
"""Outer radius, inner height and thickness of the floor of pour_water's cup, metres."""

CONTAINER = (0.68, 0.8, 0.03)
"""Inner radius at nominal factors, inner height and thickness of the container, metres."""

SETTLED = 30
"""Frames for which less sand or water must be seen: a stream or a splash is misread for some."""

PARTICLE = 0.06**3
"""Volume that a particle of water stands for, m³."""


def push_sand(limits: Mapping[str, float]) -> Physics:
    """Sand and a board."""
    return Physics(
        readings=(
            Reading("board_position", "position", ("board",)),
            Reading("board_quaternion", "quaternion", ("board",), "box"),
        ),
        objects=("board",),
        lasting=int(limits["objects.lasting"]),
        unseen=limits["objects.unseen"],
        shapes=("sand",),
        levels=(Level("sand", _sand_heights),),
        constants=(
            Constant("amount of sand", "amount", _grains, limits["amount of sand"], SETTLED),
        ),
        gaps=(Gap("sand-board", ("sand", "board"), _board_to_sand, limits["sand-board.touch"]),),
    )


def pour_water(limits: Mapping[str, float]) -> Physics:
    """Water, a cup and a container."""
    return Physics(
        readings=(
            Reading("cup_pose", "position", ("cup",), columns=(0, 1, 2)),
            Reading("container_position", "position", ("container",)),
            Reading("cup_pose", "angle", ("cup",), columns=(3,)),
        ),
        objects=("cup", "container", "holder"),
        lasting=int(limits["objects.lasting"]),
        unseen=limits["objects.unseen"],
        shapes=("water",),
        levels=(Level("water in the container", _water_level),),
        constants=(
            Constant("amount of water", "amount", _water, limits["amount of water"], SETTLED),
        ),
        gaps=(
            Gap(
                "cup-container",
                ("cup", "container"),
                _cup_to_container,
                limits["cup-container.touch"],
                limits["cup-container.solid"],
            ),
            Gap(
                "container-water",
                ("container", "water"),
                _water_in_container,
                limits["container-water.touch"],
            ),
            Gap("table-water", ("table", "water"), _water_on_table, limits["table-water.touch"]),
        ),
    )


def _grains(seen: Observation, start: States) -> Array:
    return np.asarray(seen.states["grain_count"], np.float64)[:, 0]


def _sand_heights(seen: Observation, start: States) -> Array:
    heights = np.asarray(seen.states["sand_height"], np.float64)
    return heights.reshape(len(heights), -1)


def _board_to_sand(seen: Observation, start: States) -> Array:
    """From the lower edge of the board down to the sand below it, where it is nearest."""
    middle = np.asarray(seen.states["board_position"], np.float64)
    axes = axes_of_quaternion(np.asarray(seen.states["board_quaternion"], np.float64))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in np.linspace(-1, 1, 9) for z in (-1, 1)])
    points = middle[:, None] + np.einsum("pa,tad->tpd", corners * BOARD, axes)
    heights = np.asarray(seen.states["sand_height"], np.float64)
    _, rows, columns = heights.shape
    deep, wide = SAND_EXTENT
    row = ((np.nan_to_num(points[..., 1]) + deep) / (2 * deep) * rows).astype(int)
    column = ((np.nan_to_num(points[..., 0]) + wide) / (2 * wide) * columns).astype(int)
    frame = np.arange(len(points))[:, None]
    below = heights[frame, np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
    return (points[..., 2] - below).min(-1)


def _water(seen: Observation, start: States) -> Array:
    return np.asarray(seen.states["water_count"], np.float64)[:, 0]


def _water_level(seen: Observation, start: States) -> Array:
    """How high the water that is seen in the container would stand there at rest, in m."""
    amount = _water(seen, start) * np.asarray(seen.states["water_share"][:, 1], np.float64)
    return amount[:, None] * PARTICLE / (np.pi * CONTAINER[0] ** 2)


def _depth(seen: Observation, start: States, share: int, area: float) -> Array:
    """How high a share of the water would stand on an area, in m; the amount is the true one."""
    volume = float(start["water_count"][0]) * PARTICLE
    return np.asarray(seen.states["water_share"][:, share], np.float64) * volume / area


def _water_in_container(seen: Observation, start: States) -> Array:
    return -_depth(seen, start, 1, np.pi * CONTAINER[0] ** 2)


def _water_on_table(seen: Observation, start: States) -> Array:
    return -_depth(seen, start, 2, 1.0)


def _cup_to_container(seen: Observation, start: States) -> Array:
    """From the outside of the cup to the container, which counts as solid up to its rim."""
    pose = np.asarray(seen.states["cup_pose"], np.float64)
    c, s = np.cos(pose[:, 3]), np.sin(pose[:, 3])
    x, y, z = _cup_outline().T
    turned = [c[:, None] * x + s[:, None] * z, np.broadcast_to(y, (len(c), len(y)))]
    turned.append(c[:, None] * z - s[:, None] * x)
    points = np.stack(turned, -1) + pose[:, None, :3]
    inner, tall, floor = CONTAINER
    return points_to_post(points, start["container_position"], inner + floor, tall + floor)


def _cup_outline() -> Array:
    """Points all over the outside of the cup, from the middle of its inside, `[n, 3]`."""
    radius, tall, floor = CUP
    turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    heights = np.linspace(-tall / 2 - floor, tall / 2, 7)
    return np.array([[radius * np.cos(a), radius * np.sin(a), z] for z in heights for a in turn])
