"""`ClipScores`: the scores of many clips, what they sum up to, and how sure that is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.statistics.bootstrap import Estimate, Values, defined, with_interval

Summarise = Callable[[Values, Values], float]
"""From the values and weights of clips, `[N]` each, to one number."""


@dataclass(frozen=True)
class ClipScores:
    """The scores of one predictor in one metric, clip by clip."""

    values: Values  # `[N]`, NaN where a clip has no score
    weights: Values  # how much each clip counts, `[N]`
    clips: NDArray[np.int64]  # episode and start of each, `[N, 2]`, in order
    summarise: Summarise | None = None  # sums them up; None takes the weighted mean
    # the summary where it is worked out of the clips as a set, which have no scores of their
    # own; such a summary has no interval
    whole: float | None = None

    def defined(self) -> ClipScores:
        """The clips that have a score and count."""
        kept = ~np.isnan(self.values) & (self.weights > 0)
        chosen = self.values[kept], self.weights[kept], self.clips[kept]
        return ClipScores(*chosen, self.summarise, self.whole)

    def by_clip(self) -> dict[tuple[int, int], float]:
        """The scores that are defined, by episode and start."""
        held = self.defined()
        return {(e, t): v for (e, t), v in zip(held.clips, held.values, strict=True)}

    def summary(self) -> float:
        """One number for all clips that are defined; NaN if there are none."""
        if self.whole is not None:
            return self.whole
        held = self.defined()
        return held._summed_up(np.ones(len(held.values), np.bool_)) if len(held.values) else np.nan

    def estimate(self, seed: int = 0) -> Estimate:
        """The summary with its interval, which resamples drawn with `seed` give."""
        if self.whole is not None or not len(self.defined().values):
            return Estimate(defined(self.summary()))
        return with_interval(self.summary(), [self.by_episode()], seed)

    def by_episode(self) -> Values:
        """What each episode with a defined clip says of the summary, `[E]`.

        These are the jackknife's pseudo-values (Tukey 1958), n·all − (n − 1)·all without it: for a
        mean of equal weights the mean of the episode's clips, and for any smooth summary numbers
        whose mean errs as the summary does.
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
    """The model against a reference row on the same clips."""

    difference: Estimate  # mean of model − reference over clips
    better: int  # in how many clips the model was strictly better
    clips: int  # of how many, those that are defined in both rows


def compare(
    model: ClipScores, reference: ClipScores, *, higher_is_better: bool, seed: int = 0
) -> Paired:
    """The mean difference over the clips that have a score in both, and how often it is better."""
    ours, theirs = model.by_clip(), reference.by_clip()
    clips = [clip for clip in ours if clip in theirs]
    if not clips:
        return Paired(Estimate(None), 0, 0)
    one, other = (np.array([scores[clip] for clip in clips]) for scores in (ours, theirs))
    with np.errstate(invalid="ignore"):  # two perfect clips differ by nothing, not inf − inf
        values = np.where(one == other, 0.0, one - other)
    difference = ClipScores(values, np.ones(len(values)), np.array(clips, np.int64))
    better = values > 0 if higher_is_better else values < 0
    return Paired(difference.estimate(seed), int(better.sum()), len(values))


def gap_between(inside: ClipScores, outside: ClipScores, seed: int = 0) -> Estimate:
    """The summary of one split less that of another.

    `inside`, such as the one in distribution, is subtracted from `outside`. They hold different
    episodes, which are resampled independently.
    """
    with np.errstate(invalid="ignore"):
        value = outside.summary() - inside.summary()
    if inside.whole is not None or not np.isfinite(value):
        return Estimate(defined(value))
    return with_interval(value, [outside.by_episode(), -inside.by_episode()], seed)
