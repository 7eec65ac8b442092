"""What moves in a dataset's video: the camera, a few things, or all of the picture.

Frames are made smaller until their shorter side has about `SIDE` pixels, so that numbers do not
depend on the size. All are medians over stretches of episodes.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

SIDE = 64  # pixels of the shorter side of a smaller frame
CHANGE = 20.0  # levels by which a pixel differs from another that shows something else
LATER = 4  # frames between two that are compared
CELL = 8  # pixels on a side, of the cells along the borders
TOUCHED = 0.05  # share of a cell's pixels from which it has changed
SMALLEST = 0.001  # share of the picture from which a patch of changed pixels is a thing

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Movement:
    """What was seen.

    Attributes:
        border: share of the cells along a side of the picture that change within `LATER` frames, of
            that side on which, of the four, second fewest do. A moving camera changes all sides,
            of which one may show sky, or a display.
        changed: share of the picture that differs from the median frame of its stretch.
        things: number of connected patches that do.
        apart: share of the picture in which the median frames of two stretches usually differ.
    """

    border: float
    changed: float
    things: float
    apart: float


class Movements:
    """Collects stretches of video one by one."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float, float]] = []
        self._rests: list[Floats] = []

    def add(self, video: NDArray[np.uint8]) -> None:
        """Look at a stretch `[T, 3, H, W]`; a few frames alone say nothing."""
        if len(video) <= 2 * LATER:
            return
        frames = _smaller(video)
        rest = np.median(frames, 0)
        differs = _differ(frames, rest)
        counts = [_things(frame) for frame in differs[::LATER]]
        self._rows.append((_border(frames), float(differs.mean()), float(np.mean(counts))))
        self._rests.append(rest)

    def summary(self) -> Movement | None:
        """What all of them show; None without any."""
        if not self._rows:
            return None
        usual = np.median(self._rests, 0)
        apart = [float(_differ(rest, usual).mean()) for rest in self._rests]
        border, changed, things = (float(value) for value in np.median(self._rows, 0))
        return Movement(border, changed, things, float(np.median(apart)))


def movement(videos: Iterable[NDArray[np.uint8]]) -> Movement | None:
    """What stretches of video `[T, 3, H, W]` show."""
    movements = Movements()
    for video in videos:
        movements.add(video)
    return movements.summary()


def _smaller(video: NDArray[np.uint8]) -> Floats:
    """Frames `[T, H, W, 3]`, averaged over squares of pixels."""
    frames = np.moveaxis(video, 1, -1).astype(np.float32)
    count, height, width, _ = frames.shape
    side = max(1, min(height, width) // SIDE)
    rows, columns = height // side, width // side
    cut = frames[:, : rows * side, : columns * side]
    return cut.reshape(count, rows, side, columns, side, 3).mean((2, 4))


def _differ(frames: Floats, others: Floats) -> NDArray[np.bool_]:
    return np.abs(frames - others).max(-1) > CHANGE


def _border(frames: Floats) -> float:
    """See `Movement.border`."""
    changed = _differ(frames[LATER:], frames[:-LATER])
    cell = min(CELL, *changed.shape[1:])
    sides = [changed[:, :cell], changed[:, -cell:]]
    sides += [np.swapaxes(end, 1, 2) for end in (changed[..., :cell], changed[..., -cell:])]
    shares: list[float] = []
    for side in sides:
        count, deep, long = side.shape
        cells = side[..., : long // cell * cell].reshape(count, deep, -1, cell).mean((1, 3))
        shares.append(float((cells > TOUCHED).mean()))
    return sorted(shares)[1]


def _things(differs: NDArray[np.bool_]) -> int:
    marked, _ = cast(tuple[NDArray[np.int32], int], ndimage.label(differs, np.ones((3, 3))))
    sizes = np.bincount(marked.ravel())[1:]
    return int((sizes >= max(4, SMALLEST * differs.size)).sum())
