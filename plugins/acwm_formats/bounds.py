"""The bounds of recorded actions, by which models normalise them, and outliers among them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.card import ActionSpec
from acwm_core.errors import DataError

TAIL = 0.01  # share of the values at either end that may be outliers
FAR = 3  # times as wide as the others: then they are

Ends = tuple[NDArray[np.float64], NDArray[np.float64]]


def action_bounds(rows: NDArray[np.float32], *, quantile: bool) -> Ends:
    """Lower and upper bound of every dimension of the actions ``[N, A]``.

    Args:
        rows: of the training episodes.
        quantile: leave out the outermost hundredth of the values at either end, one at least.
    """
    if not len(rows):
        raise DataError("no episode has an action")
    low, high = _inner(rows) if quantile else _range(rows)
    low, high = np.where(low < high, (low, high), _range(rows))
    still = low == high  # a dimension that never moves still needs a range
    return np.where(still, low - 1, low), np.where(still, high + 1, high)


def _range(rows: NDArray[np.float32]) -> Ends:
    return rows.min(0).astype(np.float64), rows.max(0).astype(np.float64)


def _inner(rows: NDArray[np.float32]) -> Ends:
    ordered = np.sort(rows.astype(np.float64), axis=0)
    left = min(max(1, int(TAIL * len(ordered))), (len(ordered) - 1) // 2)
    return ordered[left], ordered[len(ordered) - 1 - left]


def outliers(rows: NDArray[np.float32], names: tuple[str, ...]) -> Iterator[str]:
    """A sentence for each dimension whose range a few values widen by far."""
    inner, whole = _inner(rows), _range(rows)
    for name, least, most, low, high in zip(names, *inner, *whole, strict=True):
        if most > least and high - low > FAR * (most - least):
            yield (
                f"{name} has outliers: all but a hundredth lie between {least:g} and {most:g}, but "
                f"the bounds are {low:g} and {high:g}. --bounds quantile leaves them out"
            )


def beyond(rows: NDArray[np.float32], spec: ActionSpec) -> Iterator[str]:
    """A phrase for each dimension of the actions ``[N, A]`` that exceeds the bounds."""
    for name, least, most, low, high in zip(
        spec.names, *_range(rows), spec.low, spec.high, strict=True
    ):
        if least < np.float32(low) or most > np.float32(high):
            yield f"{name} from {least:g} to {most:g} was cut to [{low:g}, {high:g}]"
