"""Mean scores of runs that differ only in their seed, with confidence intervals.

The bootstrap over the common test episodes is widened by the standard error over seeds times draws
from Student's t, because a few seeds give only a rough estimate of their spread.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acwm_core.evaluation.statistics import (
    FLAT,
    MIN_EPISODES,
    RESAMPLES,
    ClipScores,
    Estimate,
    Values,
    around,
    defined,
    standard_error,
    studentised,
)


@dataclass(frozen=True)
class OverSeeds:
    """The mean score of runs with different seeds."""

    mean: Estimate  # with its 95 % interval over seeds and episodes
    deviation: float | None  # sample standard deviation over seeds; None with one seed
    seeds: int  # number of seeds


def over_seeds(runs: Sequence[ClipScores], seed: int = 0) -> OverSeeds:
    """The mean score of runs with different seeds.

    Args:
        runs: the scores of each run, in the same row and on the same episodes.
    """
    values = _summaries(runs)
    mean = _estimate(float(values.mean()), _episode_means(runs), [values], seed)
    several = len(values) > 1 and np.isfinite(values).all()
    return OverSeeds(mean, float(values.std(ddof=1)) if several else None, len(runs))


def difference_over_seeds(
    runs: Sequence[ClipScores], reference: Sequence[ClipScores], seed: int = 0
) -> Estimate:
    """Mean score of `runs` minus that of `reference` on the same episodes, with its 95 % interval.

    Args:
        reference: the scores of the runs to compare with; their number may differ.
    """
    ours, theirs = _summaries(runs), _summaries(reference)
    with np.errstate(invalid="ignore"):
        value = float(ours.mean() - theirs.mean())
        one, other = _episode_means(runs), _episode_means(reference)
        episodes = one - other if len(one) == len(other) else np.array([])
    return _estimate(value, episodes, [ours, theirs], seed)


def _summaries(runs: Sequence[ClipScores]) -> Values:
    return np.array([run.summary() for run in runs])


def _episode_means(runs: Sequence[ClipScores]) -> Values:
    """The mean over runs for each episode; empty if the runs do not share their episodes."""
    each = [run.by_episode() for run in runs]
    return np.mean(each, axis=0) if len({len(one) for one in each}) == 1 else np.array([])


def _estimate(value: float, episodes: Values, groups: Sequence[Values], seed: int) -> Estimate:
    """Add an interval over `episodes` and, for groups of several runs, over their seeds."""
    if not (np.isfinite(value) and np.isfinite(episodes).all()) or len(episodes) < MIN_EPISODES:
        return Estimate(defined(value))
    error, errors = standard_error(episodes), np.zeros(RESAMPLES)
    if error > FLAT * abs(float(episodes.mean())):
        errors = studentised([episodes], seed) * error
    return around(value, errors + _student(groups, seed))


def _student(groups: Sequence[Values], seed: int) -> Values:
    """Draw the error that the seeds add to a mean, or to the difference of two means.

    The degrees of freedom are Welch's (Biometrika 34, 1947).
    """
    several = [group for group in groups if len(group) > 1]
    errors = np.array([group.var(ddof=1) / len(group) for group in several])
    total = errors.sum() if len(errors) else 0.0
    if not total > 0:
        return np.zeros(RESAMPLES)
    freedom = total**2 / sum(e**2 / (len(g) - 1) for e, g in zip(errors, several, strict=True))
    return np.sqrt(total) * np.random.default_rng(seed).standard_t(freedom, RESAMPLES)
