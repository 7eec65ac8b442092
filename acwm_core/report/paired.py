"""Is a difference larger than chance? A studentised paired bootstrap, and Holm's correction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RESAMPLES = 10_000
"""Bootstrap resamples behind every p-value, which is therefore never below 1e-4."""

CONFIDENCE = 0.95

FEWEST = 5
"""Pairs below which the resamples are too few and too coarse for a p-value."""

_BLOCK = 1_000_000  # indices drawn at once


@dataclass(frozen=True)
class PairedDifference:
    """The mean difference of pairs, and what chance would make of it.

    Attributes:
        mean: over pairs.
        low: lower end of its 95 % confidence interval; None with too few pairs, or too few that
            differ at all.
        high: upper end.
        p: two-sided, of a difference so large if the true mean were zero; None with too few pairs.
        pairs: how many.
    """

    mean: float
    low: float | None
    high: float | None
    p: float | None
    pairs: int


def paired_bootstrap(
    differences: Sequence[float] | NDArray[np.float64], seed: int = 0, resamples: int = RESAMPLES
) -> PairedDifference:
    """Test the mean of paired differences against zero.

    The pairs are resampled, and each resample's mean is measured in its own standard errors
    (bootstrap-t with symmetric intervals, Hall 1988). With 8 to 20 episodes the plain percentile
    bootstrap calls 6 to 17 % of pure chance significant at 5 %, depending on the distribution; this
    one 2 to 8 %, the most for very skewed differences.

    Args:
        differences: one finite number per independent pair.
        seed: of the resamples.
        resamples: how many.
    """
    values = np.asarray(differences, dtype=np.float64)
    mean, count = float(values.mean()), len(values)
    if count < FEWEST:
        return PairedDifference(mean, None, None, None, count)
    error = float(values.std(ddof=1)) / math.sqrt(count)
    if error <= 1e-12 * abs(mean):  # all differences are the same number
        return PairedDifference(mean, mean, mean, 1.0 if mean == 0 else 1 / (resamples + 1), count)
    extremes = _studentised(values - mean, seed, resamples)
    reach = float(np.quantile(extremes, CONFIDENCE, method="higher")) * error
    p = (1 + int((extremes >= abs(mean) / error).sum())) / (resamples + 1)
    if math.isinf(reach):
        return PairedDifference(mean, None, None, p, count)
    return PairedDifference(mean, mean - reach, mean + reach, p, count)


def _studentised(centred: NDArray[np.float64], seed: int, resamples: int) -> NDArray[np.float64]:
    """How many of its own standard errors each resample's mean lies from the truth, `[resamples]`.

    A resample of one value repeated has no error of its own, and says nothing against chance: it
    counts as infinitely far off.
    """
    rng = np.random.default_rng(seed)
    count = len(centred)
    found: list[NDArray[np.float64]] = []
    rows = max(1, _BLOCK // count)
    for start in range(0, resamples, rows):
        drawn = centred[rng.integers(count, size=(min(rows, resamples - start), count))]
        errors = drawn.std(1, ddof=1) / math.sqrt(count)
        means = np.abs(drawn.mean(1))
        flat = errors <= 1e-12 * means
        found.append(np.where(flat, np.inf, means / np.where(flat, 1.0, errors)))
    return np.concatenate(found)


def holm(p_values: Sequence[float | None]) -> list[float | None]:
    """p-values corrected for their number, so that at most 5 % of such sets hold a false alarm.

    Holm's step-down procedure (1979), which needs no independence. None stays None and does not
    count.
    """
    order = sorted((p, index) for index, p in enumerate(p_values) if p is not None)
    adjusted: list[float | None] = [None] * len(p_values)
    largest = 0.0
    for rank, (p, index) in enumerate(order):
        largest = max(largest, min(1.0, (len(order) - rank) * p))
        adjusted[index] = largest
    return adjusted
