"""Converts a network's output to states, with the names and units of the card."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.rotations import angle_of_code, rotation_of_code
from acwm_estimators.curve import same_end_first
from acwm_estimators.layout import CurveField, Layout, Local, Points
from acwm_estimators.targets import MIN_SEEN, points_there
from acwm_estimators.turns import upright

Array = NDArray[np.float64]


def states_of(
    found: Mapping[str, Array],
    masks: NDArray[np.uint8],
    layout: Layout,
    card: EnvironmentCard,
) -> dict[str, NDArray[np.float32]]:
    """The state fields that a layout reads.

    Args:
        found: from the network, ``points:FIELD`` `[T, rows, 3]`, ``local:INDEX``
            `[T, count, width]`, ``totals`` `[T, K]` and ``surface`` `[T, rows, columns]`; and
            ``curve:FIELD`` `[T, nodes, 2]` in m.
        masks: ids of the card, `[T, H, W]`; rows whose instance has too few pixels become NaN.
        layout: layout of the network.
        card: card of the environment.
    """
    shapes = {field.name: field.shape for field in card.state}
    states: dict[str, Array] = {}
    there: dict[str, Array] = {}
    for points in layout.points:
        there[points.field] = points_there(masks, points, card, MIN_SEEN)
        states[points.field] = _positions(
            found[f"points:{points.field}"], points, layout, shapes[points.field]
        )
        _hide(states[points.field], there[points.field] == 0)
    for index, local in enumerate(layout.locals):
        values = decoded(found[f"local:{index}"], local)
        values[there[local.under][:, : local.count] == 0] = np.nan
        if local.column is not None:
            states[local.field][:, local.column] = values[:, 0]
        else:
            states[local.field] = values.reshape(len(values), *shapes[local.field])
    for curve in layout.curves:
        states |= _curve(found[f"curve:{curve.field}"], curve)
    states |= _amounts(found["totals"], layout.totals)
    if layout.surface:
        states[layout.surface.field] = found["surface"]
    states |= _derived(states, masks, card, layout)
    return {name: values.astype(np.float32) for name, values in states.items()}


def decoded(codes: Array, local: Local) -> Array:
    """Decode codes `[T, count, width]` to numbers `[T, count]` or quaternions `[T, count, 4]`."""
    if local.encoding == "value":
        return codes[..., 0].copy()
    if local.encoding == "axes":
        return rotation_of_code(codes, "box")
    angles = angle_of_code(codes, local.fold)
    return upright(angles) if local.encoding == "yaw" else angles


def _positions(seen: Array, points: Points, layout: Layout, shape: tuple[int, ...]) -> Array:
    if points.plane is None:
        values = layout.camera.from_frame(seen)
    else:
        values = layout.camera.on_plane(seen[..., :2], points.plane)[..., :2]
    if len(shape) > 1:
        return values
    single = np.full((len(values), *shape), np.nan)
    single[:, : values.shape[-1]] = values[:, 0]
    return single


def _hide(values: Array, hidden: NDArray[np.bool_]) -> None:
    """Set hidden rows to NaN, or a frame's whole value if the field has no rows."""
    values[hidden[:, 0] if hidden.ndim == 2 and values.ndim == 2 else hidden] = np.nan


def _curve(nodes: Array, curve: CurveField) -> dict[str, Array]:
    """The nodes and the length of a body."""
    length = np.linalg.norm(np.diff(nodes, axis=1), axis=-1).sum(-1, keepdims=True)
    return {curve.field: same_end_first(nodes), curve.length: length}


def _amounts(totals: Array, names: tuple[str, ...]) -> dict[str, Array]:
    """Amounts as fields of the card; for water, its particle count and the shares by place."""
    if names and names[0].startswith("water_"):
        count = totals.sum(-1, keepdims=True)
        return {"water_count": count, "water_share": totals[:, :3] / np.maximum(count, 1e-9)}
    return {name: totals[:, [index]] for index, name in enumerate(names)}


def _derived(
    states: Mapping[str, Array], masks: NDArray[np.uint8], card: EnvironmentCard, layout: Layout
) -> dict[str, Array]:
    """States derived from other readings: which rows are present, and angles between points."""
    derived: dict[str, Array] = {}
    shapes = {field.name: field.shape for field in card.state}
    for points in layout.points:
        if points.present in shapes:
            derived[points.present] = points_there(masks, points, card, MIN_SEEN)
    if {"elbow_position", "fingertip_position", "joint_angle"} <= {*states, *shapes}:
        upper, fore = states["elbow_position"], states["fingertip_position"]
        shoulder = np.arctan2(upper[:, 1], upper[:, 0])
        elbow = np.arctan2(*np.moveaxis(fore - upper, -1, 0)[::-1]) - shoulder
        turned = (elbow + np.pi) % (2 * np.pi) - np.pi
        derived["joint_angle"] = np.stack([shoulder, turned], axis=-1)
    return derived
