"""`ClipScores`: the scores of many clips, their summary and its confidence interval."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.evaluation.statistics.bootstrap import (
    Estimate,
    Values,
    defined,
    with_interval,
    within,
)

Summarise = Callable[[Values, Values], float]
"""Maps the values and weights of clips, each `[N]`, to one number."""


@dataclass(frozen=True)
class ClipScores:
    """The scores of one predictor in one metric, clip by clip."""

    values: Values  # `[N]`, NaN where a clip has no score
    weights: Values  # how much each clip counts, `[N]`
    clips: NDArray[np.int64]  # episode and start of each, `[N, 2]`, sorted
    summarise: Summarise | None = None  # computes the summary; None takes the weighted mean
    # the summary, if it is computed from the clips as a set and they have no scores of their own;
    # such a summary has no interval
    whole: float | None = None
    bounds: tuple[float, float] = (-math.inf, math.inf)  # of any score

    def defined(self) -> ClipScores:
        """The clips that have a score and a positive weight."""
        kept = ~np.isnan(self.values) & (self.weights > 0)
        chosen = self.values[kept], self.weights[kept], self.clips[kept]
        return ClipScores(*chosen, self.summarise, self.whole, self.bounds)

    def by_clip(self) -> dict[tuple[int, int], float]:
        """The defined scores, by episode and start."""
        held = self.defined()
        return {(e, t): v for (e, t), v in zip(held.clips, held.values, strict=True)}

    def summary(self) -> float:
        """One number for all clips with a score; NaN if there are none."""
        if self.whole is not None:
            return self.whole
        held = self.defined()
        return held._summed_up(np.ones(len(held.values), np.bool_)) if len(held.values) else np.nan

    def estimate(self, seed: int = 0) -> Estimate:
        """The summary with its confidence interval; `seed` is that of the resamples.

        The interval ends at `bounds`: what is impossible lies in no interval.
        """
        if self.whole is not None or not len(self.defined().values):
            return Estimate(defined(self.summary()))
        return within(with_interval(self.summary(), [self.by_episode()], seed), self.bounds)

    def by_episode(self) -> Values:
        """One number per episode with a defined clip, its contribution to the summary, `[E]`.

        These are the jackknife's pseudo-values (Tukey 1958): n·(summary of all) − (n − 1)·(summary
        without the episode). For a mean with equal weights this is the mean of the episode's clips.
        For any smooth summary, the mean of these numbers has the same error as the summary.
        """
        held = self.defined()
        episodes, place = np.unique(held.clips[:, 0], return_inverse=True)
        count = len(episodes)
        if count < 2:
            return np.full(count, self.summary())
        with np.errstate(invalid="ignore"):
            if held.summarise is None:
                sums = np.bincount(place, held.weights * held.values)
                totals = np.bincount(place, held.weights)
                without = (sums.sum() - sums) / (totals.sum() - totals)
            else:
                without = np.array([held._summed_up(place != each) for each in range(count)])
            return count * held.summary() - (count - 1) * without

    def _summed_up(self, kept: NDArray[np.bool_]) -> float:
        values, weights = self.values[kept], self.weights[kept]
        if self.summarise is not None:
            return self.summarise(values, weights)
        return float(np.average(values, weights=weights))


@dataclass(frozen=True)
class Paired:
    """The model compared with a reference row on the same clips."""

    difference: Estimate  # mean of model − reference over clips
    better: int  # number of clips on which the model is strictly better
    clips: int  # number of clips that have a score in both rows


def compare(
    model: ClipScores, reference: ClipScores, *, higher_is_better: bool, seed: int = 0
) -> Paired:
    """Compare clips with a score in both: mean difference, and how often the model is better."""
    ours, theirs = model.by_clip(), reference.by_clip()
    clips = [clip for clip in ours if clip in theirs]
    if not clips:
        return Paired(Estimate(None), 0, 0)
    one, other = (np.array([scores[clip] for clip in clips]) for scores in (ours, theirs))
    with np.errstate(invalid="ignore"):  # for two perfect clips take 0, not inf − inf
        values = np.where(one == other, 0.0, one - other)
    difference = ClipScores(values, np.ones(len(values)), np.array(clips, np.int64))
    better = values > 0 if higher_is_better else values < 0
    return Paired(difference.estimate(seed), int(better.sum()), len(values))


def gap_between(inside: ClipScores, outside: ClipScores, seed: int = 0) -> Estimate:
    """The summary of `outside` minus that of `inside`, e.g. of the in-distribution split.

    They hold different episodes, which are resampled independently.
    """
    with np.errstate(invalid="ignore"):
        value = outside.summary() - inside.summary()
    if inside.whole is not None or not np.isfinite(value):
        return Estimate(defined(value))
    return with_interval(value, [outside.by_episode(), -inside.by_episode()], seed)
