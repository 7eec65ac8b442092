"""What can be done with the numbers of a state field, by their kind.

`encode` makes numbers a network can take, `decode` inverts it, and `transform` applies a symmetry
of the environment. NumPy's arrays and PyTorch's tensors are taken alike, by one program.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.arrays import Array, constant, namespace, real
from acwm_core.env.camera import Camera
from acwm_core.env.rotations import (
    CODE_SIZES,
    FOLDS,
    angle_code,
    angle_of_code,
    nearest_alike,
    nearest_angle,
    product,
    rotation_code,
    rotation_of_code,
)
from acwm_core.env.state_field import PLACES, Part, StateField
from acwm_core.env.symmetry import Symmetry
from acwm_core.errors import ShapeError


def code_size(field: StateField) -> int:
    """Numbers that `encode` makes of a row of a field, E."""
    return sum(size for _, _, size in _coded_parts(field))


def encode(field: StateField, values: Array) -> Array:
    """Encode the values of a field, so that those that look alike have the same code.

    An angle becomes the cosine and sine of as many times the angle as there are ways in which the
    body looks the same; a quaternion what `rotation_code` says; all else stays as it is.

    Args:
        field: the field.
        values: `[…, *shape]`.

    Returns:
        `[…, rows, E]`; parts of a pose follow each other.
    """
    numbers: Any = rows_of(field, values)
    codes = list[Any]()
    for part, columns, _ in _coded_parts(field):
        taken = numbers[..., columns]
        if part.kind == "angle":
            coded: Any = angle_code(taken, FOLDS[field.symmetry])
            taken = coded.reshape(*coded.shape[:-2], -1)
        elif part.kind == "quaternion":
            taken = rotation_code(taken, field.symmetry)
        codes.append(taken)
    return namespace(numbers).concatenate(codes, -1)


def decode(field: StateField, codes: Array, near: Array | None = None) -> Array:
    """The values of a field from its code, which need not be exact.

    Of values that look alike, those nearest to `near`. What exists is 0 or 1. Not to be
    differentiated where there are quaternions.

    Args:
        field: the field.
        codes: `[…, rows, E]`.
        near: values `[…, *shape]`; by default angles of 0 and the identity.

    Returns:
        `[…, *shape]`.
    """
    given = real(codes)
    xp, start = namespace(given), 0
    reference: Any = None if near is None else rows_of(field, near)
    columns, values = list[int](), list[Any]()
    for part, places, size in _coded_parts(field):
        code = given[..., start : start + size]
        beside = None if reference is None else reference[..., places]
        values.append(_decoded(field, part, code, beside))
        columns, start = [*columns, *places], start + size
    joined = xp.concatenate(values, -1)[..., np.argsort(columns).tolist()]
    return joined.reshape((*given.shape[:-2], *field.shape))


def _decoded(field: StateField, part: Part, code: Any, near: Any) -> Any:
    """The values of one part, `[…, rows, n]`."""
    if part.kind == "presence":
        return (code > 0.5) * constant(1, code)
    if part.kind == "quaternion":
        near = constant([1, 0, 0, 0], code) if near is None else near
        return nearest_alike(rotation_of_code(code, field.symmetry), field.symmetry, near)
    if part.kind == "angle":
        folds = FOLDS[field.symmetry]
        angle: Any = angle_of_code(code.reshape(*code.shape[:-1], -1, 2), folds)
        return angle if near is None else nearest_angle(angle, folds, near)
    return code


def transform(field: StateField, values: Array, symmetry: Symmetry, camera: Camera | None) -> Array:
    """The values of a field in the episode that a symmetry makes of one.

    The camera says what a transformation of its picture does to the world. Of a body that is
    mirrored, it is assumed that it looks the same in the mirror while it is not turned.

    Args:
        field: the field.
        values: `[…, *shape]`.
        symmetry: a symmetry of the environment.
        camera: its camera.

    Raises:
        ShapeError: the card does not say how it is transformed: the field has values, angles
            without an axis, or there is no camera.
    """
    given: Any = values
    numbers: Any = rows_of(field, given)
    motion = None if camera is None else _motion(symmetry.mirrored, symmetry.quarter_turns, camera)
    moved, order = list[Any](), list[int]()
    for part, columns, _ in _coded_parts(field):
        taken = numbers[..., columns]
        if part.kind == "value" or (part.kind != "presence" and motion is None):
            raise ShapeError(
                f"the symmetry {symmetry.name} does not say how it transforms {field.name}, and "
                f"{'there is no camera' if motion is None else 'its kind does not imply it'}"
            )
        if motion is not None and part.kind != "presence":
            taken = _moved(field, part, taken, motion)
        moved.append(taken)
        order += columns
    joined: Any = namespace(numbers).concatenate(moved, -1)[..., np.argsort(order).tolist()]
    return _typed(joined.reshape(tuple(np.shape(given))), given)


class _Motion(NamedTuple):
    """What a symmetry does to the world: it moves places, and turns bodies."""

    linear: NDArray[np.float64]  # [3, 3], of vectors
    shift: NDArray[np.float64]  # [3], of places, after that
    mirror: NDArray[np.float64] | None  # [3, 3], if it mirrors
    axis: NDArray[np.float64]  # around which it then turns, towards the camera
    turns: int  # by so many quarter turns


@cache
def _motion(mirrored: bool, turns: int, camera: Camera) -> _Motion:
    right, down, forward = camera.axes
    mirror = np.eye(3) - 2 * np.outer(right, right) if mirrored else np.eye(3)
    quarter = np.outer(right, down) - np.outer(down, right) + np.outer(forward, forward)
    linear = _whole(np.linalg.matrix_power(quarter, turns) @ mirror)
    shift = _whole(np.asarray(camera.eye) - linear @ np.asarray(camera.eye))
    return _Motion(linear, shift, _whole(mirror) if mirrored else None, _whole(-forward), turns)


def _whole(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """The numbers, with rounding errors of whole ones removed."""
    near = np.round(numbers)
    return np.where(np.abs(numbers - near) < 1e-9, near + 0.0, numbers)


def _moved(field: StateField, part: Part, values: Any, motion: _Motion) -> Any:
    """Values `[…, rows, n]` of one part after a motion of the world."""
    if part.kind == "angle":
        return _turned_angle(field, values, motion)
    if part.kind == "quaternion":
        return _turned(values, motion)
    size, linear = values.shape[-1], motion.linear
    shift = motion.shift if part.kind in PLACES else np.zeros(3)
    if size == 2:
        height = field.height if part.kind in PLACES else 0.0
        shift = shift + height * linear[:, 2]
        if np.abs(linear[2, :2]).max() > 1e-9 or abs(shift[2] - height) > 1e-9:
            raise ShapeError(f"the symmetry moves {field.name} out of its plane")
        linear, shift = linear[:2, :2], shift[:2]
    along = (values[..., None, :] * constant(linear, values)).sum(-1)
    return along + constant(shift, values)


def _turned(quaternion: Any, motion: _Motion) -> Any:
    if motion.mirror is not None:
        # A rotation is mirrored around its mirrored axis, the other way round.
        axis = (quaternion[..., None, 1:] * constant(-motion.mirror, quaternion)).sum(-1)
        quaternion = namespace(quaternion).concatenate([quaternion[..., :1], axis], -1)
    half = motion.turns * math.pi / 4
    turn = np.concatenate([[math.cos(half)], math.sin(half) * motion.axis])
    return product(constant(turn, quaternion), quaternion) if motion.turns else quaternion


def _turned_angle(field: StateField, angle: Any, motion: _Motion) -> Any:
    if not field.axis:
        raise ShapeError(f"{field.name} has no axis, which would say how it is transformed")
    axis, sense, ahead = np.asarray(field.axis) / math.hypot(*field.axis), 1.0, 0.0
    if motion.mirror is not None:
        sense = float(-(motion.mirror @ axis) @ axis)
    if motion.turns:
        ahead = float(motion.axis @ axis)
    if abs(abs(sense) - 1) > 1e-9 or (motion.turns and abs(abs(ahead) - 1) > 1e-9):
        raise ShapeError(f"the symmetry turns the axis of {field.name}")
    turned = round(sense) * angle + round(ahead) * motion.turns * math.pi / 2
    return namespace(angle).remainder(turned + math.pi, 2 * math.pi) - math.pi


def rows_of(field: StateField, values: Array) -> Array:
    """Values `[…, *shape]` as rows of numbers to compute with, `[…, rows, n]`."""
    numbers = real(values)
    before = numbers.shape[: numbers.ndim - len(field.shape)]
    if tuple(numbers.shape[len(before) :]) != field.shape:
        raise ShapeError(f"{field.name} is {list(numbers.shape)}, not […, {list(field.shape)}]")
    return numbers.reshape(*before, field.rows, field.entries)


def _coded_parts(field: StateField) -> Iterator[tuple[Part, list[int], int]]:
    """The parts of a field, their entries of a row, and how many numbers of a code they make."""
    for part in field.parts:
        columns = list(part.columns) or list(range(field.entries))
        sizes = {"angle": 2 * len(columns), "quaternion": CODE_SIZES.get(field.symmetry, 0)}
        yield part, columns, sizes.get(part.kind, len(columns))


def _typed(values: Any, like: Any) -> Any:
    """The values with the type of numbers of `like`."""
    tensor = not isinstance(values, np.ndarray)
    converted: Any = values.to(like) if tensor else np.asarray(values, np.asarray(like).dtype)
    return converted
