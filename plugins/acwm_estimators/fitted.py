"""What a network can read of one's own world, and the camera that its card declares or data show.

An environment of acwm has a layout of its own. Of any other dataset with masks and positions, this
module finds which instance each position belongs to, and, if the card declares no camera, how
positions in the world appear in the frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.camera import Camera
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import Physics, Reading
from acwm_core.env.state_field import BodySymmetry, StateField
from acwm_core.errors import DataError
from acwm_estimators.camera import FittedCamera, with_ones
from acwm_estimators.layout import Layout, Local, Points
from acwm_estimators.targets import lifted

Array = NDArray[np.float64]

FAR = 0.05
"""Largest error, in frame heights, of an affine map from a position to the middle of its mask."""

UNEXPLAINED = 0.35
"""The same error as a share of how far the middle moves; a larger one is of something else."""

STILL = 0.02
"""Spread of a middle, in frame heights, below which it says nothing about a position."""

FEWEST = 20
"""Frames that a body must be seen in."""

FLAT = 0.02
"""Spread of a coordinate, as a share of the largest, below which it never changes."""

SAMPLES = 1500
"""Frames that a layout is found from."""

AWAY = 0.15
"""Median distance, in frame heights, between the place at which a declared camera shows a position
and the box around its mask, above which it is another camera."""

LEAST = 0.002
"""Share of the frame that a mask must cover for its middle to count."""


def fitted_layout(
    dataset: EpisodeDataset, angles: Mapping[str, int] | None = None, most: int = 200
) -> Layout:
    """What can be read of a dataset: all instances, and the positions that their masks show.

    The camera and the owners of positions are those that the card declares, else fitted ones.

    Args:
        dataset: with masks and states.
        angles: fields with angles in rad to read as well, one for each row of a position, and
            into how many equal turns a whole one is divided: 4 for a square.
        most: number of episodes to look at.

    Raises:
        DataError: it has no masks, no position that they show, or was not seen by the camera that
            its card declares.
    """
    card = dataset.card.environment
    if len(card.instances) < 2:
        raise DataError(
            f"{dataset.path} has no masks that name instances, from which a network learns: import "
            "it with masks, or threshold a colour (`acwm new estimator NAME`)"
        )
    masks, states = _samples(dataset, most)
    height, width = card.frame_size
    middles = {
        name: _middles(masks == number, height, width)
        for number, name in enumerate(card.instances)
        if number
    }
    points, pairs = list[Points](), list[tuple[Array, Array]]()
    for field in card.state:
        if not _may_be_position(field):
            continue
        rows = np.asarray(states[field.name], np.float64).reshape(len(masks), -1, field.shape[-1])
        owners = _owners(field, rows, middles)
        if all(owners):
            names = tuple(name for name in owners if name)
            plane = field.height if field.shape[-1] == 2 else None
            points.append(Points(field.name, names, plane, field.present))
            pairs += [(rows[:, row], middles[name]) for row, name in enumerate(names)]
            for row, name in enumerate(names) if card.camera else ():
                shown = masks == card.instances.index(name)
                _check_seen(card.camera, points[-1], rows[:, row], shown, name)
    if not points:
        raise DataError(
            f"no position in the states of {dataset.path} follows a mask: its states are "
            f"{', '.join(field.name for field in card.state) or 'none'}, its masks "
            f"{', '.join(card.instances[1:])}"
        )
    locals_ = tuple(_angle(name, fold, points, card) for name, fold in (angles or {}).items())
    camera = card.camera or _camera(pairs)
    return Layout(camera, card.instances[1:], tuple(points), locals_)


def fitted_physics(layout: Layout) -> Physics:
    """What can be measured: the positions and angles, of bodies that are one piece each."""
    owners = {points.field: points.instances for points in layout.points}
    turns: dict[int, BodySymmetry] = {2: "half_turn", 4: "quarter_turn"}
    readings = [Reading(points.field, "position", points.instances) for points in layout.points]
    for local in layout.locals:
        names = owners[local.under][: local.count]
        readings.append(Reading(local.field, "angle", names, turns.get(local.fold, "none")))
    return Physics(readings=tuple(readings))


def layout_from_dict(values: Mapping[str, Any]) -> Layout:
    """The layout of `fitted_layout`, from its fields after a round trip through JSON."""
    camera = values["camera"]
    return Layout(
        FittedCamera(*(tuple(map(tuple, camera[name])) for name in ("matrix", "constant")))
        if "matrix" in camera
        else Camera.from_dict(camera),
        tuple(values["instances"]),
        tuple(
            Points(each["field"], tuple(each["instances"]), each["plane"], each.get("present", ""))
            for each in values["points"]
        ),
        tuple(Local(**each) for each in values["locals"]),
    )


def _samples(dataset: EpisodeDataset, most: int) -> tuple[NDArray[np.uint8], dict[str, Array]]:
    """Masks `[F, H, W]` and states of frames that are spread over some episodes."""
    episodes = range(min(most, len(dataset)))
    each = max(2, SAMPLES // max(1, len(episodes)))
    masks, states = list[NDArray[np.uint8]](), list[dict[str, NDArray[Any]]]()
    for index in episodes:
        episode = dataset[index]
        frames = np.linspace(0, len(episode.masks) - 1, min(each, len(episode.masks))).astype(int)
        masks.append(episode.masks[frames])
        states.append({name: values[frames] for name, values in episode.states.items()})
    joined = {name: np.concatenate([each[name] for each in states]) for name in states[0]}
    return np.concatenate(masks), joined


def _middles(mask: NDArray[np.bool_], height: int, width: int) -> Array:
    """The middle of a mask in each frame, `[F, 2]` in frame heights; NaN where it is small."""
    counts = mask.sum((1, 2))
    x = (np.arange(width) + 0.5 - width / 2) / height
    y = (np.arange(height) + 0.5) / height - 0.5
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.stack([mask.sum(1) @ x / counts, mask.sum(2) @ y / counts], -1)
    middle[counts < LEAST * height * width] = np.nan
    return middle


def _may_be_position(field: StateField) -> bool:
    """Whether a field has the numbers of positions, and is not declared to be something else."""
    is_declared = field.kind == "position"
    return (is_declared or field.kind == "value") and (
        len(field.shape) in (1, 2) and field.shape[-1] in (2, 3)
    )


def _owners(field: StateField, rows: Array, middles: Mapping[str, Array]) -> list[str | None]:
    """The instance of each row of a position: the declared one, or the one that it follows."""
    if field.kind == "position" and field.owners:
        return [*field.owners]
    return [_owner(rows[:, row], middles) for row in range(rows.shape[1])]


def _check_seen(
    camera: Camera | None, points: Points, values: Array, mask: NDArray[np.bool_], name: str
) -> None:
    """Refuse a camera that shows a position `[F, D]` far from the mask `[F, H, W]` of its body."""
    if camera is None:
        return
    height, width = mask.shape[1:]
    there = mask.mean((1, 2)) >= LEAST
    if there.sum() < FEWEST:
        return
    pixels = camera.project(lifted(values[there], points.plane), height, width)[:, :2]
    shown: list[NDArray[np.bool_]] = [np.asarray(mask[there].any(axis)) for axis in (1, 2)]
    edges = [
        np.stack([line.argmax(1), line.shape[1] - line[:, ::-1].argmax(1)], -1) for line in shown
    ]
    low, high = np.moveaxis(np.stack(edges, 1), -1, 0)
    away = np.linalg.norm(np.maximum(0, np.maximum(low - pixels, pixels - high)), axis=1) / height
    if (off := float(np.nanmedian(away))) > AWAY:
        raise DataError(
            f"the camera that the card declares shows {points.field} {off:.2f} frame heights away "
            f"from the mask of {name}: correct the camera, or declare none"
        )


def _owner(values: Array, middles: Mapping[str, Array]) -> str | None:
    """The instance whose middle an affine map of a position `[F, D]` gives best, if one does."""
    best, least = None, UNEXPLAINED
    for name, middle in middles.items():
        there = np.isfinite(middle).all(1) & np.isfinite(values).all(1)
        if there.sum() < FEWEST:
            continue
        known, wanted = with_ones(values[there]), middle[there]
        map_, *_ = np.linalg.lstsq(known, wanted, rcond=None)
        off, moves = (
            float(np.sqrt((each**2).sum(1).mean()))
            for each in (known @ map_ - wanted, wanted - wanted.mean(0))
        )
        if moves > STILL and off < FAR and off / moves < least:
            best, least = name, off / moves
    return best


def _camera(pairs: Sequence[tuple[Array, Array]]) -> FittedCamera:
    """The projection that takes positions to the middles of their masks, by least squares.

    Direct linear transform with normalised coordinates (Hartley and Zisserman 2004, section 7.1).
    Positions in two dimensions lie on the plane z = 0.
    """
    world, seen = list[Array](), list[Array]()
    for values, middle in pairs:
        there = np.isfinite(middle).all(1) & np.isfinite(values).all(1)
        flat = np.zeros((int(there.sum()), 3))
        flat[:, : values.shape[1]] = values[there]
        world.append(flat)
        seen.append(middle[there])
    points, targets = np.concatenate(world), np.concatenate(seen)
    centre, scale = points.mean(0), points.std(0).max() + 1e-9
    flat = with_ones((points - centre) / scale)
    spread = points.std(0)
    used = [axis for axis in range(3) if spread[axis] > FLAT * spread.max()] + [3]
    flat = flat[:, used]
    zero = np.zeros_like(flat)
    rows = np.concatenate(
        [
            np.concatenate([flat, zero, -targets[:, :1] * flat], 1),
            np.concatenate([zero, flat, -targets[:, 1:] * flat], 1),
        ]
    )
    found = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, len(used))
    matrix = np.zeros((3, 4))
    matrix[:, used] = found
    matrix[:, :3] /= scale
    matrix[:, 3] -= matrix[:, :3] @ centre
    depth = with_ones(points) @ matrix[2]
    matrix /= depth.mean()  # w is about 1, and positive
    constant = tuple((axis, float(points[:, axis].mean())) for axis in {0, 1, 2} - {*used})
    return FittedCamera(tuple(tuple(float(value) for value in row) for row in matrix), constant)


def _angle(name: str, fold: int, points: Sequence[Points], card: EnvironmentCard) -> Local:
    """How the angles of a field are read: for the first rows of a position with as many."""
    shapes = {field.name: field.shape for field in card.state}
    if name not in shapes:
        raise DataError(f"there is no state {name!r}, but {', '.join(shapes)}")
    count = int(np.prod(shapes[name]))
    under = next((each for each in points if each.rows == count), None)
    if under is None:
        raise DataError(f"{name} has {count} angles, but no position with as many rows is read")
    return Local(name, under.field, count, "angle", fold=fold, whole=True)
