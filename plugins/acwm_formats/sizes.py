"""Sizes of frames: which a dataset may have, and frames averaged down to them."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import resolve_size
from acwm_core.errors import DataError

MIN_SIDE = 16
SMALL, MOST = 64, 96 * 96  # pixels of a side, and of a frame, that the recipe `small` is for


def target_size(
    original: tuple[int, int], size: int | tuple[int, int] | None = None
) -> tuple[int, int]:
    """The frame size ``(H, W)`` of a dataset whose videos have the size `original`.

    Args:
        original: size of the videos.
        size: the requested size, a side or a pair; by default `original`, each side rounded down to
            a multiple of 8.

    Raises:
        DataError: the videos are smaller than the requested size, or than 16 pixels.
        ShapeError: a side is not a multiple of 8, or below 16.
    """
    whole = (original[0] // 8 * 8, original[1] // 8 * 8)
    if min(whole) < MIN_SIDE:
        raise DataError(
            f"frames of {original[0]}×{original[1]} are too small: a side needs {MIN_SIDE}"
        )
    target = resolve_size(size, whole)
    if target[0] > original[0] or target[1] > original[1]:
        raise DataError(
            f"frames of {original[0]}×{original[1]} cannot be enlarged to {target[0]}×{target[1]}: "
            "give a smaller --size"
        )
    return target


def small_size(size: tuple[int, int]) -> tuple[int, int]:
    """The size of about the same shape that the recipe `small` is for; `size`, if it is small."""
    if size[0] * size[1] <= MOST:
        return size
    short = min(size)
    return round(size[0] / short * SMALL / 8) * 8, round(size[1] / short * SMALL / 8) * 8


def shrunk(frame: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Average a frame ``[H, W, 3]`` down: each new pixel is the mean of the area that it covers."""
    if frame.shape[:2] == size:
        return frame
    rows = _averaged(frame.astype(np.float32), size[0])
    means = _averaged(rows.swapaxes(0, 1), size[1]).swapaxes(0, 1)
    return np.rint(means).astype(np.uint8)


def _averaged(image: NDArray[np.float32], length: int) -> NDArray[np.float32]:
    """The mean of `image` over `length` equal intervals of its first axis."""
    total = np.zeros((length, *image.shape[1:]), np.float32)
    for index, weight in zip(*_intervals(len(image), length), strict=True):
        total += image[index] * weight[:, None, None]
    return total


@functools.cache
def _intervals(old: int, new: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """For each interval, the samples that it touches and their shares in it, both ``[K, new]``."""
    edges = np.arange(new + 1) * (old / new)
    touched = np.arange(int(np.ceil(old / new)) + 1)[:, None]
    indices = np.floor(edges[:-1]).astype(np.int64) + touched
    shares: NDArray[Any] = np.minimum(indices + 1, edges[1:]) - np.maximum(indices, edges[:-1])
    weights = np.clip(shares, 0, None)
    return np.minimum(indices, old - 1), (weights / weights.sum(0)).astype(np.float32)
