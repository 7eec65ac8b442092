"""Traces the centre line of a long thin body through the pixels that show it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from skimage.filters import gaussian
from skimage.graph import MCP_Geometric
from skimage.measure import label

Array = NDArray[np.float64]
Pixel = tuple[int, int]

MIN_LIKELIHOOD = 0.35
"""Likelihood above which a pixel belongs to the body."""

BRIDGE = 2.0
"""Factor on the length of a step where something in front hides the body."""

SMOOTH = 1.5
"""Width, in pixels, of the smoothing that turns a path of pixels into a line."""

REACH, COVERED = 4, 0.93
"""A line must have the share COVERED of the body within REACH pixels. If not, it took a short cut
where the body touches itself, and is rejected."""

MARGIN = 5
"""Margin in pixels around everything that is seen: larger than the blur of the likelihood."""

MIN_PIXELS = 8
"""Fewest pixels of a line."""


def trace(body: Array, cover: Array) -> Array | None:
    """Trace the points of the centre line from one end to the other.

    The ends are the two pixels that are farthest apart on paths through the body. The line between
    them is the path through the body's middle.

    Args:
        body: likelihood that each pixel shows the body, `[H, W]`.
        cover: likelihood that each pixel shows what may be in front of the body, `[H, W]`.

    Returns:
        Points `[N, 2]`, x and y in pixels from the upper left corner. None if too little is seen,
        or if the body touches itself so that the order of its points is unclear.
    """
    corner, window = _window((body > MIN_LIKELIHOOD) | (cover > 0.5))
    path = _path(body[window], cover[window])
    return None if path is None else smoothed(path[:, ::-1] + corner[::-1] + 0.5, SMOOTH)


def _window(seen: NDArray[np.bool_]) -> tuple[Array, tuple[slice, slice]]:
    """The upper left corner of everything that is seen, with a margin, and the slices of that part.

    This saves time: the result does not depend on the rest, and a rope takes a third of a frame.
    """
    rows, columns = (np.flatnonzero(seen.any(axis)) for axis in (1, 0))
    if not len(rows):
        return np.zeros(2), (slice(0, 1), slice(0, 1))
    top, left = max(rows[0] - MARGIN, 0), max(columns[0] - MARGIN, 0)
    window = slice(top, rows[-1] + MARGIN + 1), slice(left, columns[-1] + MARGIN + 1)
    return np.array([top, left], np.float64), window


def _path(body: Array, cover: Array) -> Array | None:
    """Rows and columns of the pixels of the centre line, `[N, 2]`; see `trace`."""
    shown, hidden = body > MIN_LIKELIHOOD, cover > 0.5
    pieces: NDArray[np.int64] = np.asarray(label(shown | hidden, connectivity=2), np.int64)
    sizes = np.bincount(pieces[shown], minlength=2)
    sizes[0] = 0
    if sizes.max() < MIN_PIXELS:
        return None
    inside = pieces == sizes.argmax()
    steps = np.where(inside, np.where(shown, 1.0, BRIDGE), -1.0)
    row, column = np.argwhere(inside & shown)[0]
    through = MCP_Geometric(steps)
    start = _farthest(through, (int(row), int(column)), inside & shown)
    end = _farthest(through, start, inside & shown)
    middle = gaussian(np.where(shown, body, 0.5 * hidden), 1.0)
    costs = np.where(inside, 1 / (0.03 + middle**2), -1.0)
    way = MCP_Geometric(costs)
    way.find_costs([start], [end])
    path = np.array(way.traceback(end), np.float64)
    if len(path) < MIN_PIXELS or _covered(path, shown) < COVERED:
        return None
    return path


def smoothed(path: Array, width: float) -> Array:
    """Smooth a path `[N, D]` along itself; its ends stay where they are."""
    reach = int(3 * width)
    ends = [2 * path[0] - path[reach:0:-1], path, 2 * path[-1] - path[-2 : -reach - 2 : -1]]
    if len(path) <= reach + 1:
        return path
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    whole = np.concatenate(ends)
    columns = [np.convolve(each, weights / weights.sum(), mode="valid") for each in whole.T]
    return np.stack(columns, axis=-1)


def evenly(points: Array, count: int, end: float = 0.0) -> Array:
    """Place `count` points at equal distances along the line through `points` `[N, D]`.

    The first and the last point lie the length `end` away from the ends of the line.
    """
    along = np.append(0, np.linalg.norm(np.diff(points, axis=0), axis=-1).cumsum())
    place = np.linspace(end, max(along[-1] - end, end), count)
    return np.stack([np.interp(place, along, each) for each in points.T], axis=-1)


def _covered(path: Array, shown: NDArray[np.bool_]) -> float:
    away = np.ones(shown.shape, np.bool_)
    away[tuple(path.astype(int).T)] = False
    distances = np.asarray(distance_transform_edt(away), np.float64)
    return float((distances[shown] <= REACH).mean())


def same_end_first(curves: Array) -> Array:
    """Reverse each of the curves `[T, N, D]` if that is closer to the previous visible curve."""
    curves = curves.copy()
    before = None
    for frame in np.flatnonzero(np.isfinite(curves).all((1, 2))):
        if before is not None:
            turned = curves[frame, ::-1].copy()
            if np.abs(turned - before).sum() < np.abs(curves[frame] - before).sum():
                curves[frame] = turned
        before = curves[frame]
    return curves


def _farthest(through: MCP_Geometric, start: Pixel, among: NDArray[np.bool_]) -> Pixel:
    costs, _ = through.find_costs([start])
    costs = np.where(among & np.isfinite(costs), costs, -1)
    y, x = np.unravel_index(int(costs.argmax()), costs.shape)
    return int(y), int(x)
