"""Means over seeds: intervals hold the truth as often as they say, in a world of known chance."""

import numpy as np
import pytest

from acwm_report.seeds import difference_over_seeds, over_seeds
from tests.statistics import worlds

EPISODES, TRIALS = 40, 200


def runs_of(scores):
    """The scores of each seed, of `[seeds, episodes]`."""
    return [worlds.scores(row) for row in scores]


def drawn(rng, seeds, episodes, mean=5.0):
    """Scores with chance of the seed (0.3), the episode (given) and of both together (0.5)."""
    seed = rng.normal(0, 0.3, (seeds, 1))
    return mean + seed + episodes + rng.normal(0, 0.5, (seeds, EPISODES))


@pytest.mark.parametrize("seeds", [2, 4])
def test_an_interval_over_seeds_and_episodes_holds_the_truth(seeds):
    rng = np.random.default_rng(0)
    held = held_by_episodes_alone = 0
    for trial in range(TRIALS):
        scores = drawn(rng, seeds, rng.normal(0, 1, EPISODES))
        mean = over_seeds(runs_of(scores), trial % 4).mean
        held += mean.low <= 5.0 <= mean.high
        alone = over_seeds(runs_of(scores.mean(0, keepdims=True)), trial % 4).mean
        held_by_episodes_alone += alone.low <= 5.0 <= alone.high
    assert 0.92 <= held / TRIALS <= 0.995
    assert held_by_episodes_alone < held


def test_differences_on_the_same_episodes_are_surer_than_the_scores():
    rng = np.random.default_rng(1)
    held, widths = 0, []
    for trial in range(TRIALS):
        episodes = rng.normal(0, 4, EPISODES)  # episodes differ much, for both alike
        ours, theirs = (runs_of(drawn(rng, n, episodes, m)) for n, m in ((3, 5.0), (4, 4.5)))
        found = difference_over_seeds(ours, theirs, trial % 4)
        held += found.low <= 0.5 <= found.high
        score = over_seeds(ours, trial % 4).mean
        widths.append((found.high - found.low) / (score.high - score.low))
    assert 0.92 <= held / TRIALS <= 0.995
    assert np.median(widths) < 0.7


def test_one_seed_has_the_interval_of_its_episodes():
    scores = drawn(np.random.default_rng(2), 1, np.arange(EPISODES) / 10)
    (column,) = runs_of(scores)
    found = over_seeds([column], seed=7)
    assert found.mean == column.estimate(7)
    assert (found.deviation, found.seeds) == (None, 1)


def test_the_deviation_is_that_of_the_seeds_means():
    scores = drawn(np.random.default_rng(3), 4, np.zeros(EPISODES))
    found = over_seeds(runs_of(scores))
    assert found.deviation == pytest.approx(scores.mean(1).std(ddof=1))
    assert found.mean.value == pytest.approx(scores.mean())
