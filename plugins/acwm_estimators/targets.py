"""Converts the true states of frames to the targets of a network."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.camera import Camera
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.rotations import angle_code, rotation_code
from acwm_estimators.camera import FittedCamera
from acwm_estimators.layout import Layout, Local, Points
from acwm_estimators.turns import heading

MIN_SEEN = 0.0006
"""Share of the frame that an instance must cover for its position to be read: over 2 pixels at a
height of 64, 34 at 240. With fewer pixels, the position would be a guess."""

Array = NDArray[np.float64]
States = Mapping[str, NDArray[Any]]


def rows_of(values: NDArray[Any], points: Points) -> Array:
    """Positions `[T, rows, D]` from the state field of `points`; adds the row axis if missing."""
    values = np.asarray(values, np.float64)
    if values.ndim == 2:
        values = values[:, None]
    return values[..., :3]


def lifted(values: Array, plane: float | None) -> Array:
    """Positions in three dimensions; those on a plane get the height of the plane."""
    if plane is None:
        return values[..., :3]
    return np.concatenate([values, np.full_like(values[..., :1], plane)], axis=-1)


def seen_points(states: States, points: Points, camera: Camera | FittedCamera) -> Array:
    """Frame coordinates and depth `[T, rows, 3]`."""
    return camera.to_frame(lifted(rows_of(states[points.field], points), points.plane))


def points_there(
    masks: NDArray[np.uint8], points: Points, card: EnvironmentCard, least: float = 0.0
) -> Array:
    """1 where a row's instance covers more than the share `least` of the frame, `[T, rows]`."""
    ids = [card.instances.index(name) for name in points.instances]
    there = np.stack([(masks == each).mean((1, 2)) > least for each in ids], axis=-1)
    return there.astype(np.float64)


def local_codes(states: States, local: Local) -> Array:
    """Encoded numbers `[T, count, width]`."""
    values = np.asarray(states[local.field], np.float64)
    if local.column is not None:
        values = values[:, None, local.column]
    if local.encoding == "value":
        return values.reshape(len(values), local.count, 1)
    if local.encoding == "angle":
        return angle_code(values.reshape(len(values), local.count), local.fold)
    values = values.reshape(len(values), local.count, 4)
    if local.encoding == "yaw":
        return angle_code(heading(values), local.fold)
    return rotation_code(values, "box")


def totals_of(states: States, names: tuple[str, ...]) -> Array:
    """Amounts `[T, K]`: fields of the card, or water particles by place."""
    if names and names[0].startswith("water_"):
        shares = np.asarray(states["water_share"], np.float64)
        air = np.clip(1 - shares.sum(-1, keepdims=True), 0, 1)
        count = np.asarray(states["water_count"], np.float64)
        return np.concatenate([shares, air], axis=-1) * count
    columns = [np.asarray(states[name], np.float64).reshape(-1, 1) for name in names]
    return np.concatenate(columns, axis=-1) if columns else np.zeros((len(_first(states)), 0))


def targets_of(
    states: States, masks: NDArray[np.uint8], layout: Layout, card: EnvironmentCard
) -> dict[str, NDArray[np.float32]]:
    """All targets of T frames, by name.

    Returns:
        ``points:FIELD`` `[T, rows, 3]`, ``there:FIELD`` `[T, rows]`, ``local:INDEX``
        `[T, count, width]`, ``totals`` `[T, K]`, and ``surface`` `[T, rows, columns]`.
    """
    targets: dict[str, Array] = {}
    for points in layout.points:
        targets[f"points:{points.field}"] = seen_points(states, points, layout.camera)
        targets[f"there:{points.field}"] = points_there(masks, points, card)
    for index, local in enumerate(layout.locals):
        targets[f"local:{index}"] = local_codes(states, local)
    targets["totals"] = totals_of(states, layout.totals)
    if layout.surface:
        targets["surface"] = np.asarray(states[layout.surface.field], np.float64)
    return {name: values.astype(np.float32) for name, values in targets.items()}


def _first(states: States) -> NDArray[Any]:
    return next(iter(states.values()))
