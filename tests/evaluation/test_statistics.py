import math

import numpy as np
import pytest

from acwm_core.evaluation.clip_results import ClipResult, read_results, write_results
from acwm_core.evaluation.results import Estimate, finite
from acwm_core.evaluation.statistics import (
    Column,
    compare,
    episode_resamples,
    gap,
    horizon,
    summarise,
)
from acwm_core.metric import Metric
from acwm_metrics.pixel import PSNR


class Error(Metric):
    name = "error"

    def per_frame(self, rollout):
        raise NotImplementedError  # statistics look at scores only


class Quality(Error):
    name = "quality"
    higher_is_better = True


METRICS = {"error": Error(), "quality": Quality()}


def clip(episode, kind, error, *, weight=1.0, curve=None, label=None, start=0):
    curve = curve or [error, error]
    return ClipResult(
        "ood_test",
        episode,
        start,
        label,
        kind,
        len(curve),
        {"error": error, "quality": -error},
        {"error": weight, "quality": 1.0},
        {"error": curve, "quality": curve},
    )


def rows(model, shuffled, copy, codec=None):
    columns = {"model": model, "shuffled": shuffled, "copy": copy, "codec": codec or model}
    return [clip(e, kind, error) for kind, c in columns.items() for e, error in enumerate(c)]


def column(values, episodes=None, starts=0):
    values = np.asarray(values, np.float64)
    episodes = range(len(values)) if episodes is None else episodes
    clips = np.stack([np.array(episodes), np.broadcast_to(starts, len(values))], 1)
    return Column(values, np.ones(len(values)), clips)


def test_means_differences_and_wins():
    scores = summarise(rows([1.0, 2.0, 3.0], [2.0, 4.0, 2.0], [5.0, 5.0, 5.0]), METRICS, seed=0)
    assert scores.clips == 3
    assert scores.rows["model"]["error"].value == 2.0
    assert scores.rows["copy"]["quality"].value == -5.0
    shuffled = scores.paired["shuffled"]
    assert shuffled["error"].difference.value == pytest.approx(-2 / 3)
    assert shuffled["quality"].difference.value == pytest.approx(2 / 3)
    assert (shuffled["error"].better, shuffled["quality"].better) == (2, 2)
    assert scores.paired["copy"]["error"].better == 3


def test_weights_reach_the_metric():
    results = [
        clip(e, kind, [1.0, 3.0][e], weight=[3.0, 1.0][e])
        for e in range(2)
        for kind in ("model", "shuffled", "copy")
    ]
    scores = summarise(results, METRICS, seed=0)
    assert scores.rows["model"]["error"].value == 1.5
    assert scores.rows["model"]["quality"].value == -2.0
    assert horizon(results, METRICS)["model"]["error"] == [1.5, 1.5]


def test_psnr_is_summed_up_by_the_metric_itself():
    errors = [1e-2, 1e-4]
    metric = PSNR()
    results = [
        ClipResult("ind_test", e, 0, None, kind, 1, {"psnr": v}, {"psnr": 1.0}, {"psnr": [v]})
        for e, v in enumerate(-10 * np.log10(np.array(errors) + 1e-8))
        for kind in ("model", "shuffled", "copy")
    ]
    pooled = -10 * math.log10(np.mean(errors) + 1e-8)
    scores = summarise(results, {"psnr": metric}, seed=0)
    assert scores.rows["model"]["psnr"].value == pytest.approx(pooled)
    assert horizon(results, {"psnr": metric})["model"]["psnr"][0] == pytest.approx(pooled)


def test_intervals_have_the_width_of_the_standard_error():
    rng = np.random.default_rng(5)
    model, other = rng.normal(0, 1, 200), rng.normal(0.5, 1, 200)
    paired = compare(column(model), column(other), Error(), seed=0)
    low, high = paired.difference.low, paired.difference.high
    assert low < paired.difference.value < high
    expected = 2 * 1.96 * np.std(model - other) / math.sqrt(200)
    assert high - low == pytest.approx(expected, rel=0.1)


def standard_error_of_clusters(values, episodes):
    """Of the mean of clusters of one size, from the means of the clusters."""
    each = [np.mean(values[episodes == episode]) for episode in np.unique(episodes)]
    return np.std(each) / math.sqrt(len(each))


def test_ten_windows_of_an_episode_are_one_observation():
    rng = np.random.default_rng(2)
    episodes = np.repeat(np.arange(40), 10)
    model = rng.normal(0, 1, 40)[episodes] + rng.normal(0, 0.1, 400)  # alike within an episode
    windows = column(model, episodes, np.tile(np.arange(10), 40))
    expected = 2 * 1.96 * standard_error_of_clusters(model, episodes)
    for metric in (Error(), Tenfold()):  # by the mean, and by a summary of the metric's own
        found = windows.estimate(metric, seed=0)
        scale = 10 if isinstance(metric, Tenfold) else 1
        assert found.value == pytest.approx(scale * model.mean())
        assert found.high - found.low == pytest.approx(scale * expected, rel=0.1)
    paired = compare(windows, column(0 * model, episodes, np.tile(np.arange(10), 40)), Error(), 0)
    width = paired.difference.high - paired.difference.low
    assert width == pytest.approx(expected, rel=0.1)
    assert width > 2 * 2 * 1.96 * np.std(model) / math.sqrt(400)  # as if they were independent


class Tenfold(Error):
    def summarise(self, values, weights=None):
        return 10 * float(np.average(values, weights=weights))


def test_every_clip_of_a_drawn_episode_is_drawn_as_often():
    counts = episode_resamples((3, 3, 5, 8, 8, 8), 0)
    assert (counts[:, 0] == counts[:, 1]).all()
    assert (counts[:, 3:] == counts[:, 3:4]).all()
    assert (counts[:, [0, 2, 3]].sum(1) == 3).all()  # as many episodes as there are
    assert counts[:, 0].mean() == pytest.approx(1, abs=0.1)


def test_clips_without_a_score_do_not_count():
    nan = math.nan
    found = column([1.0, nan, 3.0]).estimate(Error(), seed=0)
    assert (found.value, found.low, found.high) == (2.0, 1.0, 3.0)
    assert column([nan, nan]).estimate(Error(), seed=0) == Estimate(None)
    paired = compare(column([1.0, nan, 3.0]), column([2.0, 2.0, nan]), Error(), seed=0)
    assert (paired.difference.value, paired.better, paired.clips) == (-1.0, 1, 1)
    assert compare(column([nan]), column([1.0]), Error(), seed=0).clips == 0


def test_a_row_of_fewer_clips_is_compared_on_those_in_common():
    model = column([1.0, 5.0, 2.0, 9.0], [0, 0, 1, 1], [0, 7, 0, 7])
    few = column([2.0, 4.0], [0, 1], [7, 0])
    paired = compare(model, few, Error(), seed=0)
    assert (paired.difference.value, paired.better, paired.clips) == (0.5, 1, 2)


def test_pairs_are_resampled_together():
    model = np.arange(50.0)  # far apart from one another, yet always one better than the other
    paired = compare(column(model), column(model + 1), Error(), seed=0)
    assert paired.difference == Estimate(-1.0, -1.0, -1.0)


def test_the_gap_is_out_minus_in():
    inside = rows([1.0, 1.0], [2.0, 2.0], [3.0, 3.0])
    outside = rows([4.0, 4.0, 4.0], [2.0, 2.0, 2.0], [3.0, 3.0, 3.0])
    found = gap(inside, outside, METRICS, seed=0)
    assert found["model"]["error"] == Estimate(3.0, 3.0, 3.0)
    assert found["shuffled"]["error"].value == 0.0


def test_curves_of_clips_of_different_length_and_undefined_frames():
    nan = float("nan")
    curves = [[1.0, 2.0, nan], [3.0, nan]]
    results = [clip(e, "model", 0.0, curve=curve) for e, curve in enumerate(curves)]
    assert horizon(results, METRICS)["model"]["error"] == [2.0, 2.0, None]


def test_perfect_scores_are_no_nan():
    model, copy = np.array([math.inf, math.inf, 30.0]), np.array([math.inf, 20.0, 20.0])
    paired = compare(column(model), column(copy), Quality(), seed=0)
    assert paired.better == 2
    assert paired.difference == Estimate(None, None, None)
    same = compare(column(model), column(model), Quality(), seed=0)
    assert same.difference == Estimate(0.0, 0.0, 0.0)
    assert finite(math.nan) is None


def test_results_survive_parquet(tmp_path):
    results = [clip(0, "model", 0.25, label="colour"), clip(1, "copy", 0.5, weight=2.0)]
    folder = tmp_path / "evaluation"
    folder.mkdir()
    write_results(folder / "episodes.parquet", results)
    assert read_results(tmp_path) == results
