"""The paired bootstrap against textbook tests, and against chance itself."""

import numpy as np
import pytest
from scipy import stats

from acwm_core.evaluation.statistics import RESAMPLES, holm, paired_bootstrap


def test_intervals_are_those_of_the_t_test_for_normal_differences():
    rng = np.random.default_rng(3)
    for shift in (0.0, 0.3, 1.0):
        sample = rng.normal(shift, 1.0, 120)
        found, expected = paired_bootstrap(sample), stats.ttest_1samp(sample, 0)
        interval = expected.confidence_interval(0.95)
        assert found.mean == pytest.approx(sample.mean())
        assert found.low == pytest.approx(interval.low, abs=0.02)
        assert found.high == pytest.approx(interval.high, abs=0.02)
        assert found.p == pytest.approx(expected.pvalue, abs=0.02)


def test_large_samples_agree_with_scipys_bootstrap():
    sample = np.random.default_rng(4).exponential(1.0, 400) - 0.8
    found = paired_bootstrap(sample)
    other = stats.bootstrap((sample,), np.mean, n_resamples=4000, rng=0).confidence_interval
    assert (found.low, found.high) == pytest.approx((other.low, other.high), abs=0.02)


@pytest.mark.parametrize("draw", ["normal", "exponential", "standard_t"])
def test_chance_is_called_a_difference_in_about_one_of_twenty(draw):
    rng = np.random.default_rng(5)
    words = {"standard_t": {"df": 3}}.get(draw, {})
    samples = getattr(rng, draw)(size=(600, 12), **words)
    samples -= 1.0 if draw == "exponential" else 0.0
    found = [paired_bootstrap(each, resamples=500) for each in samples]
    rate = np.mean([each.p < 0.05 for each in found])
    assert 0.01 < rate < (0.1 if draw == "exponential" else 0.075)
    for each in found:  # interval and p-value say the same, but for the last resample
        if abs(each.p - 0.05) > 0.01:
            assert (each.low > 0 or each.high < 0) == (each.p < 0.05)


def test_real_differences_are_found():
    rng = np.random.default_rng(6)
    samples = rng.normal(1.0, 1.0, (200, 20))
    assert np.mean([paired_bootstrap(each, resamples=500).p < 0.05 for each in samples]) > 0.95


def test_comparisons_of_noise_with_noise_rarely_hold_a_single_false_alarm():
    """Five equal runs, so ten pairs: without a correction, a third of such sets would."""
    rng = np.random.default_rng(12)
    alarms, uncorrected = 0, 0
    for _ in range(60):
        runs = rng.normal(24, 1, (5, 15))
        pairs = [(a, b) for a in range(5) for b in range(a)]
        found = [paired_bootstrap(runs[a] - runs[b], resamples=2000).p for a, b in pairs]
        alarms += min(holm(found)) < 0.05
        uncorrected += min(found) < 0.05
    assert alarms <= 6
    assert uncorrected > 10


def test_equal_runs_and_constant_shifts():
    equal = paired_bootstrap([0.0] * 9)
    assert (equal.mean, equal.low, equal.high, equal.p) == (0.0, 0.0, 0.0, 1.0)
    shifted = paired_bootstrap([0.25] * 9)
    assert (shifted.low, shifted.high) == (0.25, 0.25)
    for pairs in (5, 9, 12):  # no surer than the sign test
        least = stats.binomtest(pairs, pairs).pvalue
        assert paired_bootstrap([0.25] * pairs).p == pytest.approx(least)
        assert paired_bootstrap(1 + 1e-3 * np.arange(pairs)).p == pytest.approx(least)
    assert paired_bootstrap([0.25] * 40).p == pytest.approx(1 / (RESAMPLES + 1))


def test_few_pairs_have_a_mean_alone():
    few = paired_bootstrap([1.0, 2.0, 3.0, 4.0])
    assert (few.mean, few.low, few.high, few.p, few.pairs) == (2.5, None, None, None, 4)


def test_holm_by_hand():
    # 0.01 · 4, then 0.02 · 3, then max(0.06, 0.03 · 2), then max(0.06, 0.5 · 1)
    assert holm([0.02, None, 0.5, 0.01, 0.03]) == pytest.approx([0.06, None, 0.5, 0.04, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


@pytest.mark.filterwarnings("error", "ignore::ResourceWarning")  # of another test
def test_a_single_pair_that_differs_has_no_interval_and_proves_nothing():
    found = paired_bootstrap([0.0] * 63 + [1.0])
    assert (found.low, found.high) == (None, None)
    assert found.p > 0.3
