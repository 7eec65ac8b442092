"""Statistics of how well two scores of the same policies agree, with bootstrap intervals."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from acwm_core.evaluation.statistics import (
    CONFIDENCE,
    MIN_EPISODES,
    Estimate,
    defined,
    with_interval,
    within,
)
from acwm_planning.policies.ranking import Agreement, Decisions

Scores = NDArray[np.float64]

RESAMPLES = 1000

Statistic = Callable[[Scores, Scores], float]
"""A function of a judge's scores `[P]` and the true scores `[P]`; NaN where it is not defined."""


def mmrv(judge: Scores, truth: Scores) -> float:
    """Mean maximum rank violation, as SimplerEnv defines it (Li et al. 2024, arXiv:2405.05941).

    A pair of policies is violated if one is better in truth but not for the judge, or the other way
    round. The violation is their true difference. A tie counts as not better, so a judge's tie
    violates a true order. The result is the mean over policies of each policy's largest violation.
    """
    better = judge[:, None] > judge[None]
    truly = truth[:, None] > truth[None]
    gap = np.abs(truth[:, None] - truth[None])
    return float(np.where(better != truly, gap, 0.0).max(1).mean())


def _pairs(scores: Scores) -> Scores:
    """Which of two is better, `[P, P]`: 1, 0 or −1."""
    return np.sign(scores[:, None] - scores[None])


def _correlation(of: Callable[[Scores], Scores]) -> Statistic:
    """Pearson's correlation of something of the scores."""

    def statistic(judge: Scores, truth: Scores) -> float:
        if len(judge) < 2 or np.ptp(judge) == 0 or np.ptp(truth) == 0:
            return math.nan
        one, other = (values - values.mean() for values in (of(judge), of(truth)))
        spread = math.sqrt((one @ one) * (other @ other))
        return float(np.clip(one @ other / spread, -1, 1)) if spread else math.nan

    return statistic


STATISTICS: Mapping[str, Statistic] = {
    "pearson": _correlation(lambda scores: scores),
    "spearman": _correlation(lambda scores: _pairs(scores).sum(1)),  # twice the rank, shifted
    "kendall": _correlation(lambda scores: _pairs(scores).ravel()),  # τ-b, which accounts for ties
    "mmrv": mmrv,
    "optimism": lambda judge, truth: float((judge - truth).mean()),
}


def agreement(judge: Scores, truth: Scores, seed: int = 0, resamples: int = RESAMPLES) -> Agreement:
    """Compute how well scores agree, over policies and episodes.

    Intervals are percentiles over bootstrap resamples of the policies and, independently, of the
    episodes that all policies share. With fewer than `MIN_EPISODES` episodes, only policies are
    resampled. There is no interval with fewer than `MIN_EPISODES` policies, or if the statistic is
    defined in less than half of the resamples.

    Args:
        judge: the judge's scores `[P, E]` of policies in episodes.
        truth: the true scores `[P, E]`.
        seed: seed of the resampling.
        resamples: number of resamples.
    """
    policies, episodes = truth.shape
    rng = np.random.default_rng(seed)
    samples: dict[str, list[float]] = {name: [] for name in STATISTICS}
    every, several = np.arange(episodes), episodes >= MIN_EPISODES
    for _ in range(resamples if policies >= MIN_EPISODES else 0):
        rows = rng.integers(policies, size=policies)
        columns = rng.integers(episodes, size=episodes) if several else every
        pair = (scores[rows][:, columns].mean(1) for scores in (judge, truth))
        means = tuple(pair)
        for name, statistic in STATISTICS.items():
            samples[name].append(statistic(*means))
    values = {
        name: _estimate(statistic(judge.mean(1), truth.mean(1)), np.array(samples[name]))
        for name, statistic in STATISTICS.items()
    }
    return Agreement(**values)


def _estimate(value: float, samples: Scores) -> Estimate:
    finite = samples[np.isfinite(samples)]
    if math.isnan(value) or not len(finite) or len(finite) < len(samples) / 2:
        return Estimate(defined(value))
    low, high = np.quantile(finite, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(value, float(low), float(high))


def regret(judge: Scores, truth: Scores) -> tuple[float, float]:
    """Regret of a judge's choice among the action sequences of a start, and of a random choice.

    Args:
        judge: the judge's returns `[n]` of the sequences. Among sequences that tie for the best,
            the choice is random.
        truth: the true returns `[n]`.
    """
    chosen = truth[judge == judge.max()].mean()
    return float(truth.max() - chosen), float(truth.max() - truth.mean())


def decisions(judge: list[Scores], truth: list[Scores]) -> Decisions:
    """Regrets of choices at many starts, with intervals over the starts."""
    regrets = np.array([regret(*pair) for pair in zip(judge, truth, strict=True)]).reshape(-1, 2)
    lost, chance, gain = (
        with_interval(float(values.mean()), [values])
        for values in (regrets[:, 0], regrets[:, 1], regrets[:, 1] - regrets[:, 0])
    )
    regret_bounds = 0.0, math.inf
    return Decisions(len(regrets), within(lost, regret_bounds), within(chance, regret_bounds), gain)
