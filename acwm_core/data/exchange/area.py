"""Shrinking frames by exact area averaging, and which sizes a dataset's frames may have."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import resolve_size
from acwm_core.errors import DataError

SIDE = 8  # the sides of a dataset's frames are multiples of it
LEAST = 16
MOST_BYTES = 2**32  # of one episode


def target_size(
    found: tuple[int, int], size: int | tuple[int, int] | None = None
) -> tuple[int, int]:
    """The frame size ``(H, W)`` of a dataset whose videos have the size `found`.

    Args:
        found: size of the videos.
        size: what was asked for, a side or a pair; by default `found`, each side rounded down to
            a multiple of 8.

    Raises:
        DataError: the videos are smaller than that, or than 16 pixels.
        ShapeError: a side that is not a multiple of 8, or below 16.
    """
    whole = (found[0] // SIDE * SIDE, found[1] // SIDE * SIDE)
    if min(whole) < LEAST:
        raise DataError(f"frames of {found[0]}×{found[1]} are too small: a side needs {LEAST}")
    wanted = resolve_size(size, whole)
    if wanted[0] > found[0] or wanted[1] > found[1]:
        raise DataError(
            f"frames of {found[0]}×{found[1]} cannot be enlarged to {wanted[0]}×{wanted[1]}: "
            "give a smaller --size"
        )
    return wanted


def shrink(frame: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """A frame ``[H, W, 3]`` at the smaller `size`; each new pixel is the mean of what it covers."""
    if frame.shape[:2] == size:
        return frame
    rows = _averaged(frame.astype(np.float32), size[0])
    columns = _averaged(rows.swapaxes(0, 1), size[1]).swapaxes(0, 1)
    return np.rint(columns).astype(np.uint8)


def shrunk(frames: Iterable[NDArray[np.uint8]], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Frames, taken one at a time, as ``[T, H, W, 3]`` at the smaller `size`.

    Raises:
        DataError: a frame is smaller than that, there is none, or more than memory may hold.
    """
    small: list[NDArray[np.uint8]] = []
    most = MOST_BYTES // (size[0] * size[1] * 3)
    for frame in frames:
        target_size((frame.shape[0], frame.shape[1]), size)
        if len(small) == most:
            raise DataError(f"it has more than {most} frames of {size[0]}×{size[1]}: cut it up")
        small.append(shrink(frame, size))
    if not small:
        raise DataError("it holds no frame")
    return np.stack(small)


def _averaged(image: NDArray[np.float32], length: int) -> NDArray[np.float32]:
    """The mean of `image` over `length` equal intervals of its first axis."""
    indices, weights = _intervals(len(image), length)
    total = np.zeros((length, *image.shape[1:]), np.float32)
    for index, weight in zip(indices, weights, strict=True):
        total += image[index] * weight[:, None, None]
    return total


@functools.cache
def _intervals(old: int, new: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Per interval the samples that it touches and their shares in it, both ``[K, new]``."""
    edges = np.arange(new + 1) * (old / new)
    touched = int(np.ceil(old / new)) + 1
    indices = np.floor(edges[:-1]).astype(np.int64) + np.arange(touched)[:, None]
    shares: NDArray[Any] = np.minimum(indices + 1, edges[1:]) - np.maximum(indices, edges[:-1])
    weights = np.clip(shares, 0, None)
    weights /= weights.sum(0)
    return np.minimum(indices, old - 1), weights.astype(np.float32)
