"""Agreement of scores against SciPy, against examples worked out by hand, and against chance."""

import functools

import numpy as np
import pytest
from scipy import stats

from acwm_planning.policies.agreement import agreement, decisions, mmrv, regret

RNG = np.random.default_rng(0)


def test_mmrv_by_hand():
    """Truth 0.9, 0.6, 0.3, 0.1; the judge has the middle two the wrong way round.

    Their violations are 0.3 each, those of the others 0: 0.6 over four policies.
    """
    truth, judge = np.array([0.9, 0.6, 0.3, 0.1]), np.array([0.8, 0.2, 0.5, 0.0])
    assert mmrv(judge, truth) == pytest.approx(0.15)
    # upside down: the best and the worst are violated by 0.8, the others by 0.5 and 0.6 at most
    assert mmrv(-truth, truth) == pytest.approx((0.8 + 0.5 + 0.6 + 0.8) / 4)
    assert mmrv(3 * truth - 7, truth) == 0


def test_mmrv_with_ties():
    """Strictly better is what counts, so a tie of the judge violates a true order, of the better.

    And an order of the judge violates a true tie, by nothing, for the truth differs by nothing.
    """
    truth = np.array([0.9, 0.6, 0.6])
    assert mmrv(np.array([0.5, 0.5, 0.5]), truth) == pytest.approx(0.3 / 3)
    assert mmrv(np.array([0.9, 0.2, 0.1]), truth) == 0


def test_correlations_are_those_of_scipy():
    judge, truth = RNG.normal(size=(2, 9, 1))
    judge[:3] = 0.5  # ties
    found = agreement(judge, truth)
    pair = judge[:, 0], truth[:, 0]
    assert found.pearson.value == pytest.approx(stats.pearsonr(*pair).statistic)
    assert found.spearman.value == pytest.approx(stats.spearmanr(*pair).statistic)
    assert found.kendall.value == pytest.approx(stats.kendalltau(*pair).statistic)
    assert found.optimism.value == pytest.approx((judge - truth).mean())
    few = agreement(judge[:4], truth[:4])
    assert few.mmrv.low is few.optimism.high is None  # four policies tell nothing of chance


def test_what_is_constant_has_no_correlation():
    found = agreement(np.full((6, 5), 1.0), RNG.normal(size=(6, 5)))
    assert found.pearson.value is found.spearman.value is found.kendall.value is None
    assert found.mmrv.value > 0
    alone = agreement(np.ones((1, 8)), np.zeros((1, 8)))
    assert (alone.spearman.value, alone.optimism.value, alone.optimism.low) == (None, 1, None)


@pytest.mark.ci
def test_intervals_cover_policies_and_episodes():
    intervals, random = functools.partial(agreement, resamples=200), np.random.default_rng(0)
    skill = np.linspace(0, 1, 12)[:, None]
    judge, truth = (skill + 0.3 * random.normal(size=(12, 10)) for _ in range(2))
    noisy = skill + 0.3 * random.normal(size=(8, 2, 12, 40))
    few, many = ([intervals(*each[..., :n]).spearman for each in noisy] for n in (5, 40))
    assert all(each.low < each.value < each.high <= 1 for each in few)
    assert sum(each.low for each in many) > sum(each.low for each in few)
    # with fewer episodes they are of policies alone, and so of any number of the same ones
    one = intervals(judge[:, :1], truth[:, :1]).spearman
    assert one.low < one.value < one.high
    assert one == intervals(*(np.repeat(each[:, :1], 3, 1) for each in (judge, truth))).spearman
    same = intervals(truth, truth)
    for each in (same.pearson, same.spearman, same.kendall):
        assert (each.value, each.low, each.high) == pytest.approx((1, 1, 1))
    for each in (same.mmrv, same.optimism):
        assert (each.value, each.low, each.high) == (0, 0, 0)
    off = intervals(truth + 0.25, truth)
    assert (off.optimism.low, off.optimism.high) == pytest.approx((0.25, 0.25))


def test_regret_by_hand():
    truth = np.array([-1.0, -2.0, -3.0, -4.0, -5.0])
    assert regret(truth, truth) == (0, 2)
    assert regret(np.array([0.0, 0, 5, 0, 0]), truth) == (2, 2)
    assert regret(-truth, truth) == (4, 2)
    # who cannot tell chooses by chance
    assert regret(np.zeros(5), truth) == (2, 2)
    assert regret(np.array([7.0, 7, 0, 0, 0]), truth) == (0.5, 2)


def test_regrets_are_means_over_starts():
    truth = [RNG.normal(size=5) for _ in range(8)]
    best, blind = decisions(truth, truth), decisions([np.zeros(5)] * 8, truth)
    chance = np.mean([each.max() - each.mean() for each in truth])
    assert (best.starts, best.regret.value, best.regret.high) == (8, 0, 0)
    assert best.chance.value == blind.regret.value == pytest.approx(chance)
    assert best.gain.low > 0
    assert (blind.gain.value, blind.gain.low, blind.gain.high) == pytest.approx((0, 0, 0))
