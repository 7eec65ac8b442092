"""How far two directions are apart, for bodies that look the same after certain turns."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
from numpy.typing import NDArray

from acwm_core.estimator import Symmetry

PERIODS = {"none": 2 * np.pi, "half_turn": np.pi, "quarter_turn": np.pi / 2}
"""Of an angle, by symmetry, in rad."""


def angle_between(
    first: NDArray[np.floating], second: NDArray[np.floating], symmetry: Symmetry
) -> NDArray[np.float64]:
    """The smaller angle between two angles, in [0, period / 2] rad."""
    period = PERIODS[symmetry]
    return np.abs((np.asarray(first, np.float64) - second + period / 2) % period - period / 2)


def turn_between(
    first: NDArray[np.floating], second: NDArray[np.floating], symmetry: Symmetry
) -> NDArray[np.float64]:
    """The angle of the smallest rotation that takes one orientation to one that looks the other.

    Args:
        first: `[…, 4]` quaternions (w, x, y, z) of any length but 0.
        second: like `first`.
        symmetry: of the body, in its own frame.

    Returns:
        `[…]` in [0, π] rad.
    """
    unit = [
        np.asarray(q, np.float64) / np.linalg.norm(q, axis=-1)[..., None] for q in (first, second)
    ]
    same = product(unit[0][..., None, :], rotations_of(symmetry))
    cosines = np.abs((same * unit[1][..., None, :]).sum(-1)).max(-1)
    return 2 * np.arccos(np.clip(cosines, 0, 1))


def product(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The quaternion product a b, `[…, 4]`: the rotation b, then a."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


@cache
def rotations_of(symmetry: Symmetry) -> NDArray[np.float64]:
    """The rotations `[n, 4]` after which a body looks the same.

    Raises:
        ValueError: it is a symmetry of angles.
    """
    if symmetry == "none":
        return np.array([[1.0, 0, 0, 0]])
    if symmetry == "box":
        return np.eye(4)
    if symmetry == "cube":
        return np.array(sorted(_cube()))
    raise ValueError(f"{symmetry} is the symmetry of an angle, not of an orientation")


def _cube() -> set[tuple[float, ...]]:
    """The 24 rotations of a cube; of each and its negative, which is the same, one."""
    half = np.sqrt(0.5)
    found = [tuple(row) for row in np.eye(4)]
    for pair in itertools.combinations(range(4), 2):
        for sign in (half, -half):
            row = np.zeros(4)
            row[pair[0]], row[pair[1]] = half, sign
            found.append(tuple(row))
    found += [(0.5, *signs) for signs in itertools.product((0.5, -0.5), repeat=3)]
    return {tuple(float(x) for x in row) for row in found}
