"""Feature statistics as in LeRobot datasets, per episode and for the whole dataset."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Stats = dict[str, NDArray[Any]]
"""Statistics by name: `min`, `max`, `mean`, `std`, `count` and the quantiles."""

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
SHOWN = 16  # most frames of an episode that are sampled for colour statistics
FINE = 64  # approximate number of sampled rows and columns of a frame


def statistics(rows: NDArray[Any]) -> Stats:
    """Statistics of the columns of ``[N, n]``, each with shape (n,); ``[N]`` is one column."""
    values = rows.reshape(len(rows), -1).astype(np.float64)
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    return {
        "min": values.min(0),
        "max": values.max(0),
        "mean": values.mean(0),
        "std": values.std(0),
        "count": np.array([len(values)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def colour_statistics(video: NDArray[np.uint8]) -> Stats:
    """Statistics of the colours of ``[T, H, W, 3]`` in [0, 1], each with shape (3, 1, 1).

    Only a sample of frames and pixels is used; `count` is the number of these frames.
    """
    chosen = np.linspace(0, len(video) - 1, min(SHOWN, len(video))).astype(int)
    height, width = video.shape[1:3]
    sample = video[chosen, :: max(1, height // FINE), :: max(1, width // FINE)]
    stats = statistics(sample.reshape(-1, 3) / 255)
    shaped = {name: value.reshape(3, 1, 1) for name, value in stats.items() if name != "count"}
    return {**shaped, "count": np.array([len(chosen)])}


def combined(parts: list[Stats]) -> Stats:
    """Combine the statistics of parts.

    Quantiles are the weighted means of the parts' quantiles, as in LeRobot; all others are exact.
    """
    counts = np.array([part["count"][0] for part in parts], np.float64)
    weights = counts / counts.sum()

    def mean(name: str, power: int = 1) -> NDArray[Any]:
        return sum(w * part[name] ** power for w, part in zip(weights, parts, strict=True))  # pyright: ignore[reportReturnType]

    average = mean("mean")
    variance = mean("std", 2) + mean("mean", 2) - average**2
    return {
        "min": np.min([part["min"] for part in parts], axis=0),
        "max": np.max([part["max"] for part in parts], axis=0),
        "mean": average,
        "std": np.sqrt(np.maximum(variance, 0)),
        "count": np.array([int(counts.sum())]),
        **{name: mean(name) for name in QUANTILES},
    }


def plain(stats: Mapping[str, Stats]) -> dict[str, dict[str, Any]]:
    """Convert the statistics of features to JSON types."""
    return {key: {name: v.tolist() for name, v in part.items()} for key, part in stats.items()}
