"""Encodes angles and orientations as numbers that a network can regress, and decodes them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acwm_sim.geometry import rotations

Array = NDArray[np.float64]


def encode_angle(angle: Array, fold: int) -> Array:
    """Encode angles `[…]` in radians as cosine and sine `[…, 2]` of `fold` times the angle."""
    return np.stack([np.cos(fold * angle), np.sin(fold * angle)], axis=-1)


def decode_angle(code: Array, fold: int) -> Array:
    """The inverse of `encode_angle`, in [-π / fold, π / fold]; the code may have any length."""
    return np.arctan2(code[..., 1], code[..., 0]) / fold


def heading(quaternion: Array) -> Array:
    """Rotation around z of quaternions `[…, 4]` (w, x, y, z), in radians."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def upright(angle: Array) -> Array:
    """Quaternions `[…, 4]` of rotations around z."""
    zero = np.zeros_like(angle)
    return np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=-1)


def encode_axes(quaternion: Array) -> Array:
    """Encode quaternions `[…, 4]` as the upper triangles of x xᵀ and z zᵀ, `[…, 12]`.

    x and z are axes of the rotated body. The four rotations after which a box looks the same only
    change the signs of the axes, so they do not change the code.
    """
    axes = rotations(np.roll(quaternion, -1, axis=-1))
    rows, columns = np.triu_indices(3)
    squares = [axes[..., :, k, None] * axes[..., None, :, k] for k in (0, 2)]
    return np.concatenate([square[..., rows, columns] for square in squares], axis=-1)


def decode_axes(code: Array) -> Array:
    """Decode `[…, 12]` to the nearest rotation `[…, 4]`, one of the four that look the same."""
    x, z = (_principal(code[..., part]) for part in (slice(0, 6), slice(6, 12)))
    x = x - z * (x * z).sum(-1, keepdims=True)
    x = x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-9)
    axes: Array = np.stack([x, np.cross(z, x), z], axis=-1).astype(np.float64)
    return _quaternion(axes)


def _principal(triangle: Array) -> Array:
    """The eigenvector `[…, 3]` of the largest eigenvalue of matrices given by upper triangles."""
    rows, columns = np.triu_indices(3)
    matrix = np.zeros((*triangle.shape[:-1], 3, 3), np.float64)
    matrix[..., rows, columns] = triangle
    matrix[..., columns, rows] = triangle
    return np.linalg.eigh(matrix)[1][..., :, -1]


def _quaternion(m: Array) -> Array:
    """Quaternions of rotation matrices `[…, 3, 3]`, by the method of Bar-Itzhack (2000)."""
    k = np.zeros((*m.shape[:-2], 4, 4))
    trace = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    k[..., 0, 0] = trace
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        k[..., 0, i + 1] = k[..., i + 1, 0] = m[..., b, a] - m[..., a, b]
        for j in range(3):
            k[..., i + 1, j + 1] = m[..., i, j] + m[..., j, i] - (i == j) * trace
    return np.linalg.eigh(k)[1][..., :, -1]
