"""Orientations (quaternions w, x, y, z) and the codes by which networks know them.

A code is the same for orientations that look alike, and changes steadily as a body turns.
"""

from __future__ import annotations

import itertools
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.arrays import Array, constant, namespace, real
from acwm_core.env.state_field import BodySymmetry

FOLDS = {"none": 1, "half_turn": 2, "quarter_turn": 4, "box": 2, "cube": 4}
"""In how many ways a body can be turned around one axis and look the same, by symmetry; a box or
cube around one of its own."""

CODE_SIZES = {"none": 6, "box": 12, "cube": 9}
"""Numbers of the code of an orientation, by symmetry; see `rotation_code`."""

_UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])
_LEAST = 1e-9  # a length below which a vector has no direction


def product(a: Array, b: Array) -> Array:
    """The quaternion product a b, `[…, 4]`: rotate by b, then by a."""
    first, second = real(a), real(b)
    aw, ax, ay, az = (first[..., k] for k in range(4))
    bw, bx, by, bz = (second[..., k] for k in range(4))
    return namespace(first).stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def matrix_of(quaternion: Array) -> Array:
    """Rotation matrices `[…, 3, 3]` of quaternions `[…, 4]` of any length except 0."""
    q = real(quaternion)
    w, x, y, z = (_unit(q)[..., k] for k in range(4))
    xp = namespace(q)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return xp.stack([xp.stack(list(row), -1) for row in rows], -2)


def quaternion_of(matrix: Array) -> Array:
    """Quaternions `[…, 4]` of rotation matrices `[…, 3, 3]`, by the method of Bar-Itzhack (2000).

    Of a matrix that is none, the nearest rotation. The sign is arbitrary.
    """
    m = real(matrix)
    xp = namespace(m)

    def at(i: int, j: int) -> Any:
        return m[..., i, j]

    trace = at(0, 0) + at(1, 1) + at(2, 2)
    rows = [[trace, at(2, 1) - at(1, 2), at(0, 2) - at(2, 0), at(1, 0) - at(0, 1)]]
    for i in range(3):
        rest = [at(i, j) + at(j, i) - (trace if i == j else 0) for j in range(3)]
        rows.append([rows[0][i + 1], *rest])
    square = xp.stack([xp.stack(row, -1) for row in rows], -2)
    return xp.linalg.eigh(square)[1][..., :, -1]


@cache
def rotations_of(symmetry: BodySymmetry) -> NDArray[np.float64]:
    """The rotations `[n, 4]` after which a body looks the same.

    Raises:
        ValueError: it is a symmetry of angles, not of orientations.
    """
    if symmetry == "none":
        return np.array([[1.0, 0, 0, 0]])
    if symmetry == "box":
        return np.eye(4)
    if symmetry == "cube":
        return np.array(sorted(_cube()))
    raise ValueError(f"{symmetry} is the symmetry of an angle, not of an orientation")


def _cube() -> set[tuple[float, ...]]:
    """The 24 rotations of a cube; q and −q are the same rotation, and only one is included."""
    half = np.sqrt(0.5)
    rows = [tuple(row) for row in np.eye(4)]
    for pair in itertools.combinations(range(4), 2):
        for sign in (half, -half):
            row = np.zeros(4)
            row[pair[0]], row[pair[1]] = half, sign
            rows.append(tuple(row))
    rows += [(0.5, *signs) for signs in itertools.product((0.5, -0.5), repeat=3)]
    return {tuple(float(x) for x in row) for row in rows}


def nearest_alike(quaternion: Array, symmetry: BodySymmetry, to: Array) -> Array:
    """Of the quaternions that look like these `[…, 4]`, those nearest to others `[…, 4]`."""
    q, reference = real(quaternion), real(to)
    alike: Any = product(q[..., None, :], constant(rotations_of(symmetry), q))
    cosines = (alike * reference[..., None, :]).sum(-1)
    best = constant(np.eye(alike.shape[-2]), q)[abs(cosines).argmax(-1)]
    sign = namespace(q).sign((best * cosines).sum(-1) + _LEAST)
    return ((best * sign[..., None])[..., None] * alike).sum(-2)


def angle_code(angle: Array, folds: int) -> Array:
    """Cosine and sine `[…, 2]` of `folds` times angles `[…]` in rad."""
    turned = folds * real(angle)
    xp = namespace(turned)
    return xp.stack([xp.cos(turned), xp.sin(turned)], -1)


def angle_of_code(code: Array, folds: int) -> Array:
    """The inverse of `angle_code`, in [-π / folds, π / folds]; the code may have any length."""
    values = real(code)
    return namespace(values).arctan2(values[..., 1], values[..., 0]) / folds


def nearest_angle(angle: Array, folds: int, to: Array) -> Array:
    """Of the angles that look like these `[…]`, in rad, those nearest to others `[…]`."""
    values: Any = real(angle)
    period = 2 * np.pi / folds
    return values + period * ((real(to) - values) / period).round()


def angle_difference(first: Array, second: Array, folds: int) -> Array:
    """How far angles `[…]` are from others that may look alike, in [-π / folds, π / folds)."""
    period = 2 * np.pi / folds
    return (real(first) - real(second) + period / 2) % period - period / 2


def rotation_code(quaternion: Array, symmetry: BodySymmetry) -> Array:
    """Encode orientations `[…, 4]`, `[…, E]` with E of `CODE_SIZES`.

    Without symmetry: the body's x and y axes (Zhou et al. 2019, arXiv:1812.07035). Of a box: the
    upper triangles of x xᵀ and z zᵀ, as its rotations only change the signs of the axes. Of a cube:
    nine entries of the sum of the fourth tensor powers of the axes, from which the others follow.
    """
    axes: Any = matrix_of(quaternion)
    xp = namespace(axes)
    if symmetry == "none":
        return xp.concatenate([axes[..., :, 0], axes[..., :, 1]], -1)
    if symmetry == "box":
        rows, columns = _UPPER
        squares = [axes[..., rows, k] * axes[..., columns, k] for k in (0, 2)]
        return xp.concatenate(squares, -1)
    entries = [axes[..., i, :] ** a * axes[..., j, :] ** b for i, a, j, b in _FOURTH]
    return xp.stack([entry.sum(-1) for entry in entries], -1)


_PAIRS = ((0, 1), (0, 2), (1, 2))
_FOURTH = (
    *((i, 4, i, 0) for i in range(3)),
    *((i, 3, j, 1) for i, j in _PAIRS),
    *((i, 1, j, 3) for i, j in _PAIRS),
)
"""Entries of the code of a cube: two coordinates and their powers."""


def rotation_of_code(code: Array, symmetry: BodySymmetry) -> Array:
    """The inverse of `rotation_code`: one of the quaternions `[…, 4]` that look alike.

    Of a code that is not exactly one, a rotation nearby.
    """
    values = real(code)
    if symmetry == "none":
        return quaternion_of(_of_axes(values))
    return quaternion_of(_of_squares(values) if symmetry == "box" else _of_fourth(values))


def _of_axes(code: Any) -> Any:
    """Rotation matrices of x and y axes that are nearly those of one."""
    x = _unit(code[..., :3])
    return _columns(x, _unit(_without(code[..., 3:], x)))


def _of_squares(code: Any) -> Any:
    z = _principal(code[..., 6:])
    x = _unit(_without(_principal(code[..., :6]), z))
    return _columns(x, _cross(z, x))


def _principal(triangle: Any) -> Any:
    """The eigenvector `[…, 3]` of the largest eigenvalue of matrices given by upper triangles."""
    order = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
    return namespace(triangle).linalg.eigh(triangle[..., order])[1][..., :, -1]


@cache
def _tensor_of_code() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The fourth power tensor of a cube `[81]` as a constant and what is linear in the code.

    By Σ T_llij = δ_ij, as axes are at right angles and of length 1.
    """
    still, linear = np.zeros(81), np.zeros((81, 9))
    for row, entry in enumerate(itertools.product(range(3), repeat=4)):
        counts = [entry.count(axis) for axis in range(3)]
        if 4 in counts:
            linear[row, counts.index(4)] = 1
        elif 3 in counts:
            linear[row, _FOURTH.index(_mixed(counts.index(3), counts.index(1)))] = 1
        elif 1 in counts:
            j, k = (axis for axis in range(3) if counts[axis] == 1)
            for pair in ((j, k), (k, j)):
                linear[row, _FOURTH.index(_mixed(*pair))] = -1
        else:
            still[row] = 0.5
            linear[row, :3] = np.where(np.array(counts) == 2, -0.5, 0.5)
    return still, linear


def _mixed(cubed: int, single: int) -> tuple[int, int, int, int]:
    return (cubed, 3, single, 1) if cubed < single else (single, 1, cubed, 3)


_STARTS = np.array([p for p in itertools.product((-1.0, 0.0, 1.0), repeat=3) if p > (0, 0, 0)])
_STEPS = 16  # power iterations, which converge cubically
_AROUND = np.arange(8) * np.pi / 8


def _of_fourth(code: Any) -> Any:
    """Rotation matrices of cubes, whose axes are the maxima of Σ (axis · v)⁴ on the sphere."""
    still, linear = (constant(numbers, code) for numbers in _tensor_of_code())
    entries = still + (linear * code[..., None, :]).sum(-1)
    tensor = entries.reshape(*code.shape[:-1], 3, 3, 3, 3)
    tries = _unit(constant(_STARTS, code)) + 0 * code[..., None, :3]
    for _ in range(_STEPS):
        tries = _unit(_slope(tensor, tries))
    best = (_slope(tensor, tries) * tries).sum(-1).argmax(-1)
    x = (constant(np.eye(len(_STARTS)), code)[best][..., None] * tries).sum(-2)
    # Around that axis the polynomial is constant + a cos 4t + b sin 4t.
    y = _unit(_without(constant(np.eye(3), code)[abs(x).argmin(-1)], x))
    z = _cross(x, y)
    cosine, sine = (constant(wave(_AROUND), code)[:, None] for wave in (np.cos, np.sin))
    around = cosine * y[..., None, :] + sine * z[..., None, :]
    height = (_slope(tensor, around) * around).sum(-1)
    a, b = ((height * constant(wave(4 * _AROUND), code)).sum(-1) for wave in (np.cos, np.sin))
    turn = (namespace(code).arctan2(b, a) / 4)[..., None]
    return _columns(x, namespace(code).cos(turn) * y + namespace(code).sin(turn) * z)


def _slope(tensor: Any, v: Any) -> Any:
    """A quarter of the gradient of the polynomial of a tensor at vectors `[…, n, 3]`."""
    equation = "...ijkl,...sj,...sk,...sl->...si"
    return namespace(v).einsum(equation, tensor, v, v, v)


def _columns(x: Any, y: Any) -> Any:
    """The matrix of two axes and the third one."""
    return namespace(x).stack([x, y, _cross(x, y)], -1)


def _cross(a: Any, b: Any) -> Any:
    order = [[1, 2, 0], [2, 0, 1]]
    (a1, a2), (b1, b2) = ([vectors[..., k] for k in order] for vectors in (a, b))
    return a1 * b2 - a2 * b1


def _without(v: Any, axis: Any) -> Any:
    """Vectors without their parts along an axis of length 1."""
    return v - (v * axis).sum(-1)[..., None] * axis


def _unit(v: Any) -> Any:
    return v / ((v * v).sum(-1)[..., None] ** 0.5).clip(_LEAST)
