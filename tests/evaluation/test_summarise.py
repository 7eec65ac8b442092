import math
from dataclasses import replace

import numpy as np
import pytest

from acwm_core.evaluation.metric import Metric
from acwm_core.evaluation.results import Estimate, Score, SetSummary
from acwm_core.evaluation.shares import error_shares
from acwm_core.evaluation.storage import read_scores, write_scores
from acwm_core.evaluation.summarise import gap, horizon, summarise
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
    return Score(
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
        Score("ind_test", e, 0, None, kind, 1, {"psnr": v}, {"psnr": 1.0}, {"psnr": [v]})
        for e, v in enumerate(-10 * np.log10(np.array(errors) + 1e-8))
        for kind in ("model", "shuffled", "copy")
    ]
    pooled = -10 * math.log10(np.mean(errors) + 1e-8)
    scores = summarise(results, {"psnr": metric}, seed=0)
    assert scores.rows["model"]["psnr"].value == pytest.approx(pooled)
    assert horizon(results, {"psnr": metric})["model"]["psnr"][0] == pytest.approx(pooled)


def test_the_gap_is_out_minus_in():
    inside = rows([1.0] * 5, [2.0] * 5, [3.0] * 5)
    outside = rows([4.0] * 6, [2.0] * 6, [3.0] * 6)
    found = gap(inside, outside, METRICS, seed=0)
    assert found["model"]["error"] == Estimate(3.0, 3.0, 3.0)
    assert found["shuffled"]["error"].value == 0.0


def test_curves_of_clips_of_different_length_and_undefined_frames():
    nan = float("nan")
    curves = [[1.0, 2.0, nan], [3.0, nan]]
    results = [clip(e, "model", 0.0, curve=curve) for e, curve in enumerate(curves)]
    assert horizon(results, METRICS)["model"]["error"] == [2.0, 2.0, None]


def test_results_survive_parquet(tmp_path):
    results = [clip(0, "model", 0.25, label="colour"), clip(1, "copy", 0.5, weight=2.0)]
    folder = tmp_path / "evaluation"
    folder.mkdir()
    write_scores(folder / "episodes.parquet", results)
    assert read_scores(tmp_path) == results


@pytest.mark.parametrize("metric", ["mse", "psnr"])
def test_where_the_squared_error_comes_from(metric):
    errors = {"model": 0.01, "codec": 0.0025, "perturbed": 0.001, "copy": 0.03}
    values = {k: v if metric == "mse" else -10 * math.log10(v) for k, v in errors.items()}
    rows = {kind: {metric: Estimate(value)} for kind, value in values.items()}
    found = error_shares(SetSummary(1, rows, {}))
    assert found is not None
    assert (found.codec, found.world, found.model) == pytest.approx((0.25, 0.1, 0.65))
    assert [part in str(found) for part in ("25 %", "10 %", "65 %")] == [True] * 3
    del rows["perturbed"]
    found = error_shares(SetSummary(1, rows, {}))
    assert found is not None
    assert (found.world, found.model) == (None, pytest.approx(0.75))
    assert error_shares(SetSummary(1, {"model": {"ssim": Estimate(0.9)}}, {})) is None


def test_shares_that_are_scored_are_means_over_clips():
    given = (0.2, 0.8, math.nan)  # none where there was nothing to score
    clips = [replace(clip(e, "model", 1.0), shares={"error": x}) for e, x in enumerate(given)]
    assert summarise(clips, METRICS, 0).shares == {"model": {"error": 0.5}}
