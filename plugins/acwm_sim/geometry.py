"""Rotations, and signed distances between the surfaces of simple bodies (negative if they overlap).

Numpy only. The poses of bodies are given per frame; all lengths are in metres.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

DIRECTIONS, MIN_FREE = 48, 12
"""Number of directions to measure a radius in, and how many of them must be free."""


def rotations(quaternions: ArrayLike) -> Array:
    """Rotation matrices `[…, 3, 3]` of unit quaternions `[…, 4]`, (x, y, z, w)."""
    x, y, z, w = np.moveaxis(np.asarray(quaternions, np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def distance(first: Array, second: Array) -> Array:
    """Distance between points `[…, D]`."""
    return np.linalg.norm(first - second, axis=-1)


def axes_of(yaw: Array) -> Array:
    """The two axes `[…, 2, 2]` (axis, x and y) of a body rotated by `yaw` on a table."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([np.stack([c, s], -1), np.stack([-s, c], -1)], -2)


def axes_of_quaternion(quaternion: Array) -> Array:
    """The three axes `[…, 3, 3]` (axis, xyz) of a body with this quaternion (w, x, y, z)."""
    unit = quaternion / np.linalg.norm(quaternion, axis=-1)[..., None]
    return np.ascontiguousarray(rotations(np.roll(unit, -1, axis=-1)).swapaxes(-1, -2))


def disc_to_box(center: Array, radius: float, middle: Array, axes: Array, half: Array) -> Array:
    """Distance from a disc to a box in 2-D, or from a ball to a box in 3-D.

    Args:
        center: `[T, D]`, centre of the disc or ball.
        radius: radius of the disc or ball.
        middle: `[T, D]`, centre of the box.
        axes: `[T, D, D]`, axes of the box, one per row.
        half: half the sides of the box, `[D]` or one number for all.
    """
    beyond = np.abs(np.einsum("tad,td->ta", axes, center - middle)) - half
    outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1)
    return outside + np.minimum(beyond.max(-1), 0) - radius


def box_to_box(
    middles: tuple[Array, Array], axes: tuple[Array, Array], halves: tuple[Array, Array]
) -> Array:
    """Distance between two boxes along the best separating axis (Gottschalk 1996).

    Exact if they overlap or a corner or edge is nearest to a face; a lower bound if two corners are
    nearest. Arguments are pairs (one per box) of those of `disc_to_box`.
    """
    tried = np.concatenate([*axes, *_crossed(*axes)], 1)
    reach = sum(
        (np.abs(np.einsum("tad,tbd->tab", tried, each)) * half).sum(-1)
        for each, half in zip(axes, halves, strict=True)
    )
    apart = np.abs(np.einsum("tad,td->ta", tried, middles[1] - middles[0])) - reach
    return np.asarray(apart.max(-1), np.float64)


def _crossed(first: Array, second: Array) -> list[Array]:
    """Unit cross products of edges in 3-D; parallel edges give one of the face axes again."""
    if first.shape[-1] == 2:
        return []
    crossed = np.cross(first[:, :, None], second[:, None]).reshape(len(first), 9, 3)
    length = np.linalg.norm(crossed, axis=-1, keepdims=True)
    return [np.where(length > 1e-3, crossed / np.maximum(length, 1e-3), first[:, :1])]


def point_to_curve(point: Array, curve: Array) -> Array:
    """Distance from points `[T, D]` to the nearest point on polylines `[T, n, D]`."""
    start, along = curve[:, :-1], np.diff(curve, axis=1)
    square = np.maximum((along**2).sum(-1), 1e-12)
    share = ((point[:, None] - start) * along).sum(-1) / square
    nearest = start + np.clip(share, 0, 1)[..., None] * along
    return distance(nearest, point[:, None]).min(-1)


def points_to_post(points: Array, place: Array, radius: float, height: float) -> Array:
    """Smallest distance of points `[T, n, 3]` to an upright cylinder, per frame.

    The cylinder stands on z = 0 at `place` ([2] or [3]).
    """
    aside = np.hypot(points[..., 0] - place[0], points[..., 1] - place[1]) - radius
    above = points[..., 2] - height
    outside = np.hypot(np.maximum(aside, 0), np.maximum(above, 0))
    return (outside + np.minimum(np.maximum(aside, above), 0)).min(-1)


def outer_radius(masks: NDArray[np.uint8], instance: int, middle: Array) -> Array:
    """Radius of a round instance, from its middle to the background, `[T]`.

    The mean over directions, without the quarter with the largest and the quarter with the smallest
    radii. Directions in which another instance covers the rim do not count; the radius is NaN if
    only few directions are left.

    Args:
        masks: `[T, H, W]`, the background is 0.
        instance: id of the instance.
        middle: `[2]`, x to the right and y down from the frame's middle. All lengths are in frame
            heights.
    """
    height, width = masks.shape[1:]
    angles = np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)[:, None]
    radii = np.arange(1, 2 * height) / (4 * height)  # in quarters of pixels, to half the height
    x = (middle[0] + np.cos(angles) * radii) * height + width / 2
    y = (middle[1] + np.sin(angles) * radii) * height + height / 2
    rows, columns = (np.clip(v.astype(int), 0, n - 1) for v, n in ((y, height), (x, width)))
    labels = masks[:, rows, columns]
    own = labels == instance
    last = own.shape[-1] - 1 - own[..., ::-1].argmax(-1)
    beyond = np.minimum(last + 1, own.shape[-1] - 1)
    free = own.any(-1) & (np.take_along_axis(labels, beyond[..., None], -1)[..., 0] == 0)
    enough = free.sum(1) >= MIN_FREE
    reached = np.where(free[enough], radii[last[enough]], np.nan)
    found = np.full(len(masks), np.nan)
    if enough.any():
        low, high = np.nanquantile(reached, (0.25, 0.75), axis=1, keepdims=True)
        kept = (reached >= low) & (reached <= high)  # a few pixels are always wrong
        found[enough] = np.where(kept, reached, 0).sum(1) / kept.sum(1)
    return found
