"""Means over seeds: intervals hold the truth as often as they say, in a world of known chance."""

import numpy as np
import pytest

from acwm_core.catalog import catalog
from acwm_core.evaluation.seeds import difference, over_seeds
from acwm_core.evaluation.statistics import Column

EPISODES, TRIALS = 40, 200


@pytest.fixture(scope="module")
def metric():
    return catalog().component("metric", "mse").load()()


def columns(scores):
    """A column per seed of scores `[seeds, episodes]`."""
    clips = np.stack([np.arange(EPISODES), np.zeros(EPISODES)], 1).astype(np.int64)
    return [Column(row, np.ones(EPISODES), clips) for row in scores]


def drawn(rng, seeds, episodes, mean=5.0):
    """Scores with chance of the seed (0.3), the episode (given) and of both together (0.5)."""
    seed = rng.normal(0, 0.3, (seeds, 1))
    return mean + seed + episodes + rng.normal(0, 0.5, (seeds, EPISODES))


@pytest.mark.parametrize("seeds", [2, 4])
def test_an_interval_over_seeds_and_episodes_holds_the_truth(seeds, metric):
    rng = np.random.default_rng(0)
    held = held_by_episodes_alone = 0
    for trial in range(TRIALS):
        scores = drawn(rng, seeds, rng.normal(0, 1, EPISODES))
        mean = over_seeds(columns(scores), metric, trial).mean
        held += mean.low <= 5.0 <= mean.high
        alone = over_seeds(columns(scores.mean(0, keepdims=True)), metric, trial).mean
        held_by_episodes_alone += alone.low <= 5.0 <= alone.high
    assert 0.92 <= held / TRIALS <= 0.99
    assert held_by_episodes_alone < held


def test_differences_on_the_same_episodes_are_surer_than_the_scores(metric):
    rng = np.random.default_rng(1)
    held, widths = 0, []
    for trial in range(TRIALS):
        episodes = rng.normal(0, 4, EPISODES)  # episodes differ much, for both alike
        ours, theirs = (columns(drawn(rng, n, episodes, m)) for n, m in ((3, 5.0), (4, 4.5)))
        found = difference(ours, theirs, metric, trial)
        held += found.low <= 0.5 <= found.high
        score = over_seeds(ours, metric, trial).mean
        widths.append((found.high - found.low) / (score.high - score.low))
    assert 0.92 <= held / TRIALS <= 0.99
    assert np.median(widths) < 0.7


def test_one_seed_has_the_interval_of_its_episodes(metric):
    scores = drawn(np.random.default_rng(2), 1, np.arange(EPISODES) / 10)
    (column,) = columns(scores)
    found = over_seeds([column], metric, seed=7)
    assert found.mean == column.estimate(metric, 7)
    assert (found.deviation, found.seeds) == (None, 1)


def test_the_deviation_is_that_of_the_seeds_means(metric):
    scores = drawn(np.random.default_rng(3), 4, np.zeros(EPISODES))
    found = over_seeds(columns(scores), metric)
    assert found.deviation == pytest.approx(scores.mean(1).std(ddof=1))
    assert found.mean.value == pytest.approx(scores.mean())
