"""Scores of runs that differ in their seed alone: how sure is their mean?

Two things are drawn by chance: the test episodes, which all runs share, and the seeds of training.
The interval of a mean over runs accounts for both: the bootstrap over episodes of the mean over
runs, widened by the standard error over seeds times draws of Student's t, because few seeds tell
little of their own spread. With one seed only the episodes count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.evaluation.results import Estimate, finite
from acwm_core.evaluation.statistics import INTERVAL, RESAMPLES, Column
from acwm_core.metric import Metric


@dataclass(frozen=True)
class OverSeeds:
    """The mean of a score over runs.

    Attributes:
        mean: with its 95 % interval over seeds and episodes.
        deviation: sample standard deviation over seeds; None with one seed.
        seeds: how many.
    """

    mean: Estimate
    deviation: float | None
    seeds: int


def over_seeds(runs: Sequence[Column], metric: Metric, seed: int = 0) -> OverSeeds:
    """The mean score of runs.

    Args:
        runs: the same row of each, on the same episodes.
        metric: what was measured.
        seed: of the bootstrap.
    """
    values, episodes = _scores(runs, metric), _episodes(runs, metric, seed)
    spread = episodes + _student([values], seed)
    return OverSeeds(_with_interval(float(values.mean()), spread), _deviation(values), len(runs))


def difference(
    runs: Sequence[Column], reference: Sequence[Column], metric: Metric, seed: int = 0
) -> Estimate:
    """The mean score of runs less that of others on the same episodes, with its 95 % interval.

    Args:
        runs: the same row of each.
        reference: that of the runs to compare with; their number may differ.
        metric: what was measured.
        seed: of the bootstrap.
    """
    ours, theirs = _scores(runs, metric), _scores(reference, metric)
    same_draws = _episodes(runs, metric, seed) - _episodes(reference, metric, seed)
    return _with_interval(
        float(ours.mean() - theirs.mean()), same_draws + _student([ours, theirs], seed)
    )


def _scores(runs: Sequence[Column], metric: Metric) -> NDArray[np.float64]:
    return np.array([run.defined().summary(metric) for run in runs])


def _episodes(runs: Sequence[Column], metric: Metric, seed: int) -> NDArray[np.float64]:
    """Bootstrap samples of the mean over runs; each draws the same episodes of all of them."""
    return np.mean([run.defined().spread(metric, seed) for run in runs], axis=0)


def _student(groups: Sequence[NDArray[np.float64]], seed: int) -> NDArray[np.float64]:
    """Draws of what the seeds add to the error of a mean, or of a difference of two.

    The degrees of freedom are Welch's (Biometrika 34, 1947).
    """
    several = [group for group in groups if len(group) > 1]
    errors = np.array([group.var(ddof=1) / len(group) for group in several])
    total = errors.sum() if len(errors) else 0.0
    if not total > 0 or not np.isfinite(total):
        return np.zeros(RESAMPLES)
    freedom = total**2 / sum(e**2 / (len(g) - 1) for e, g in zip(errors, several, strict=True))
    return np.sqrt(total) * np.random.default_rng(seed).standard_t(freedom, RESAMPLES)


def _deviation(values: NDArray[np.float64]) -> float | None:
    if len(values) < 2 or not np.all(np.isfinite(values)):
        return None
    return float(values.std(ddof=1))


def _with_interval(value: float, spread: NDArray[np.float64]) -> Estimate:
    if not np.all(np.isfinite(spread)):
        return Estimate(finite(value))
    low, high = np.quantile(spread, INTERVAL)
    return Estimate(finite(value), finite(low), finite(high))
