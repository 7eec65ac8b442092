"""How a video changes from frame to frame, as few numbers: which way, how much, and where."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

ROWS = 32  # rows or columns of a small frame, whichever are fewer
GRIDS = (1, 2, 4)  # a frame is described as a whole, in quarters, and in sixteenths


def small(video: NDArray[np.uint8]) -> Floats:
    """Frames ``[T, 3, H, W]`` averaged down to about `ROWS` rows, in [0, 1]."""
    frames, colours, height, width = video.shape
    side = max(1, min(height, width) // ROWS)
    rows, columns = height // side, width // side
    cut = video[:, :, : rows * side, : columns * side]
    blocks = cut.reshape(frames, colours, rows, side, columns, side)
    return blocks.mean((3, 5), dtype=np.float32) / 255


def motion(frames: Floats) -> Floats:
    """Describe the changes between small frames ``[T, 3, h, w]`` by ``[T − 1, 63]``.

    For the whole frame, its quarters and its sixteenths: the change along the vertical and along
    the horizontal gradient of the image, whose signs tell which way something moved wherever it
    was, and the sum of all changes. The whole frame comes first.
    """
    change, between = np.diff(frames, axis=0), (frames[1:] + frames[:-1]) / 2
    down, right = np.gradient(between, axis=(2, 3))
    maps = [-(down * change).sum(1), -(right * change).sum(1), np.abs(change).sum(1)]
    return np.stack([cell for grid in GRIDS for image in maps for cell in _cells(image, grid)], 1)


def _cells(image: Floats, grid: int) -> list[Floats]:
    """Sums of ``[T, h, w]`` over the cells of a grid, each ``[T]``."""
    rows = np.array_split(np.arange(image.shape[1]), grid)
    columns = np.array_split(np.arange(image.shape[2]), grid)
    pairs = itertools.product(rows, columns)
    return [image[:, r[0] : r[-1] + 1, c[0] : c[-1] + 1].sum((1, 2)) for r, c in pairs]


def poses(frames: list[Floats], count: int = 6) -> list[Floats]:
    """The first principal components of small frames, ``[T, count]`` per video: what is where."""
    flat = [video.reshape(len(video), -1) for video in frames]
    whole = np.concatenate(flat)
    some = whole[np.linspace(0, len(whole) - 1, min(len(whole), 1000)).astype(int)]
    mean = some.mean(0)
    _, size, axes = np.linalg.svd(some - mean, full_matrices=False)
    scale = size[:count] / np.sqrt(len(some)) + 1e-9
    return [((rows - mean) @ axes[:count].T / scale).astype(np.float32) for rows in flat]
