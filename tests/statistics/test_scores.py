"""Summaries of clips: their intervals hold the truth as often as they say."""

import dataclasses
import math

import numpy as np
import pytest

from acwm_core.evaluation.statistics import ClipScores, Estimate, compare, finite, gap_between
from tests.statistics.worlds import decibels, pooled, scores

TRIALS = 300

SPREAD = 0.6
"""Of the logarithm of skewed draws."""

WORLDS = {
    "normal": (lambda rng, n: scores(rng.normal(3, 1, n)), 3.0),
    "skewed": (lambda rng, n: scores(rng.lognormal(0, SPREAD, n)), math.exp(SPREAD**2 / 2)),
    "pooled": (
        lambda rng, n: scores(decibels(rng.lognormal(0, SPREAD, n)), summarise=pooled),
        decibels(math.exp(SPREAD**2 / 2)),
    ),
    "windows": (  # four of each episode, alike within it
        lambda rng, n: scores(
            np.repeat(rng.normal(3, 1, n), 4) + rng.normal(0, 0.3, 4 * n),
            np.repeat(np.arange(n), 4),
            np.tile(np.arange(4), n),
        ),
        3.0,
    ),
}
"""What draws scores of so many episodes, and the true summary."""


@pytest.mark.parametrize("episodes", [8, pytest.param(20, marks=pytest.mark.ci), 64])
@pytest.mark.parametrize("world", WORLDS)
def test_intervals_hold_the_truth_in_nineteen_of_twenty_cases(world, episodes):
    draw, truth = WORLDS[world]
    rng = np.random.default_rng(4)
    found = [draw(rng, episodes).estimate() for _ in range(TRIALS)]
    assert 0.92 <= np.mean([each.low <= truth <= each.high for each in found]) <= 0.98


def test_intervals_of_a_gap_hold_the_truth_as_often():
    rng = np.random.default_rng(5)
    pairs = [(scores(rng.normal(0, 1, 20)), scores(rng.normal(2, 3, 8))) for _ in range(TRIALS)]
    found = [gap_between(inside, outside) for inside, outside in pairs]
    assert 0.92 <= np.mean([each.low <= 2 <= each.high for each in found]) <= 0.98


def test_weights_decide_what_clips_and_episodes_count():
    rng = np.random.default_rng(6)
    values, weights = rng.normal(0, 1, 40), rng.uniform(0.1, 3, 40)
    clips = np.stack([np.arange(40), np.zeros(40)], 1).astype(np.int64)
    found = ClipScores(values, weights, clips).estimate()
    assert found.value == np.average(values, weights=weights)
    residuals = weights * (values - found.value) / weights.mean()
    error = residuals.std(ddof=1) / math.sqrt(40)  # of a quotient of means
    assert found.high - found.low == pytest.approx(2 * 2.02 * error, rel=0.15)


def test_clips_without_a_score_do_not_count():
    nan = math.nan
    found = scores([1.0, nan, *[3.0] * 5, 1.0]).estimate()
    assert found == scores([1.0, *[3.0] * 5, 1.0]).estimate()
    assert scores([nan, nan]).estimate() == Estimate(None)
    paired = compare(scores([1.0, nan, 3.0]), scores([2.0, 2.0, nan]), higher_is_better=False)
    assert (paired.difference.value, paired.better, paired.clips) == (-1.0, 1, 1)
    assert compare(scores([nan]), scores([1.0]), higher_is_better=False).clips == 0


def test_fewer_than_five_episodes_have_no_interval():
    assert scores([1.0, 2.0, 3.0, 4.0]).estimate() == Estimate(2.5)
    assert scores(np.arange(12.0), np.arange(12) // 3).estimate() == Estimate(5.5)
    assert gap_between(scores(np.arange(9.0)), scores([1.0, 2.0])) == Estimate(-2.5)


def test_an_interval_ends_where_scores_do():
    shares = scores([1.0] * 9 + [0.9] * 3 + [0.2])
    free = shares.estimate()
    assert free.high > 1
    bounded = dataclasses.replace(shares, bounds=(0.0, 1.0)).estimate()
    assert bounded == Estimate(free.value, free.low, 1.0)


def test_a_row_of_fewer_clips_is_compared_on_those_in_common():
    model = scores([1.0, 5.0, 2.0, 9.0], [0, 0, 1, 1], [0, 7, 0, 7])
    few = scores([2.0, 4.0], [0, 1], [7, 0])
    paired = compare(model, few, higher_is_better=False)
    assert (paired.difference.value, paired.better, paired.clips) == (0.5, 1, 2)


def test_pairs_are_resampled_together():
    model = np.arange(50.0)  # far apart from one another, yet always one better than the other
    paired = compare(scores(model), scores(model + 1), higher_is_better=False)
    assert paired.difference == Estimate(-1.0, -1.0, -1.0)
    assert paired.better == 50


def test_perfect_scores_are_no_nan():
    model, copy = [math.inf] * 5 + [30.0], [math.inf] * 4 + [20.0] * 2
    paired = compare(scores(model), scores(copy), higher_is_better=True)
    assert paired.better == 2
    assert paired.difference == Estimate(math.inf)
    same = compare(scores(model), scores(model), higher_is_better=True)
    assert same.difference == Estimate(0.0, 0.0, 0.0)
    assert scores(model).estimate() == Estimate(math.inf)
    assert finite(math.nan) is None


def test_what_is_worked_out_of_the_clips_as_a_set_has_no_interval():
    whole = dataclasses.replace(scores([math.nan] * 9), whole=7.0)
    assert whole.estimate() == Estimate(7.0)
    assert gap_between(whole, dataclasses.replace(whole, whole=9.0)) == Estimate(2.0)
    assert compare(whole, whole, higher_is_better=True).difference == Estimate(None)
