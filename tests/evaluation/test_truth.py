"""Rows that are measured by some of the metrics: the truth, and the model under wrong actions."""

import numpy as np
import pytest

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.physics import Observation, Physics, StateEstimator
from acwm_core.evaluation.clips import Clip, plan_clips
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.metric import Metric
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.score import build_metrics, measured_in, split_available
from acwm_core.evaluation.summarise import summarise_split
from acwm_core.training.run import load_run

OFF = 0.25


class Corner(StateEstimator):
    """The corner of the brightest square, a quarter of a pixel off."""

    fields = ("position",)
    instances = ("square",)

    @property
    def physics(self):
        return Physics()

    def estimate(self, video):
        red = video[:, 0].numpy()
        masks = (red >= red.max((1, 2), keepdims=True) - 0.05).astype(np.uint8)
        corners = [np.argwhere(mask).min(0) for mask in masks]
        return Observation(masks, {"position": np.array(corners, np.float32) + OFF})

    def pixels(self, field, values):
        return np.asarray(values)[..., ::-1]


class CornerError(Metric):
    name = "corner_error"
    unit = "px"

    def unavailable(self, card, estimator):
        return None if estimator else "no estimator reads this"

    def per_frame(self, prediction):
        true = np.asarray(prediction.states["position"], float).round()
        return np.abs(prediction.observed.states["position"] - true).mean(-1)


@pytest.fixture(scope="module")
def scored(evaluated, data):
    return score_all(evaluated, data)


def score_all(evaluated, data, **settings):
    bundle = load_run(evaluated)
    config = EvaluationConfig(frames=9, device="cpu", steps_sweep=[], **settings)
    metrics = {**build_metrics(["mse", "psnr"]), "corner_error": CornerError()}
    estimator = Corner(bundle.card)
    evaluator = Evaluator(bundle.world_model, bundle.card, metrics, config, estimator)
    episodes = EpisodeDataset(data, "ind_test")
    plans = plan_clips("ind_test", episodes.lengths, config)
    results = evaluator.scores(plans, episodes)
    assert len(results) == evaluator.count_rows(plans)
    return results, metrics


def test_the_estimators_own_error_stands_in_the_row_of_the_truth(scored):
    results, metrics = scored
    rows = summarise_split(results, metrics, 0).scores.rows
    assert rows["truth"]["corner_error"].value == pytest.approx(OFF, abs=0.02)
    assert rows["truth"]["corner_error"].value < rows["copy"]["corner_error"].value
    assert rows["codec"]["mse"].value > 0


def test_pixels_of_the_truth_are_not_compared_with_themselves(scored):
    results, _ = scored
    truths = [result for result in results if result.kind == "truth"]
    assert len(truths) == 5
    for result in truths:
        assert np.isnan(result.values["mse"])
        assert np.isnan(result.values["psnr"])
        assert np.isnan(result.curves["mse"]).all()
        assert np.isfinite(result.curves["corner_error"]).all()


def test_no_states_are_read_of_predictions_under_wrong_actions(scored):
    results, metrics = scored
    others = [result for result in results if result.kind == "shuffled"]
    assert len(others) == 5
    for result in others:
        assert np.isnan(result.values["corner_error"])
        assert np.isnan(result.curves["corner_error"]).all()
        assert np.isfinite(result.curves["mse"]).all()
    scores = summarise_split(results, metrics, 0).scores
    assert scores.paired["shuffled"]["corner_error"].clips == 0
    assert scores.paired["shuffled"]["psnr"].clips == 5


def test_the_noise_floor_is_measured_on_the_first_episodes_alone(evaluated, data, scored):
    results, metrics = score_all(evaluated, data, noise_floor_episodes=2)
    every = {(r.episode, r.kind): r for r in scored[0]}
    assert {(r.episode, r.kind) for r in results} == {
        (episode, kind) for episode, kind in every if kind != "truth" or episode < 2
    }
    for result in results:
        full = every[result.episode, result.kind]
        assert result.values["mse"] == pytest.approx(full.values["mse"], nan_ok=True)
        unread = result.kind == "codec" and result.episode >= 2
        expected = np.nan if unread else full.values["corner_error"]
        assert result.values["corner_error"] == pytest.approx(expected, nan_ok=True)
    rows = summarise_split(results, metrics, 0).scores.rows
    of_two = [every[episode, "codec"].values["corner_error"] for episode in (0, 1)]
    assert rows["codec"]["corner_error"].value == pytest.approx(np.mean(of_two))
    assert rows["codec"]["mse"].value == pytest.approx(
        np.mean([r.values["mse"] for r in scored[0] if r.kind == "codec"])
    )


def test_no_noise_floor_at_all_may_be_asked_for(evaluated, data):
    results, metrics = score_all(evaluated, data, noise_floor_episodes=0)
    rows = summarise_split(results, metrics, 0).scores.rows
    assert "truth" not in rows
    assert rows["codec"]["corner_error"].value is None
    assert rows["model"]["corner_error"].value is not None


@pytest.mark.parametrize("names", [[], ["mse"]])
def test_what_ranks_clips_is_measured_under_wrong_actions_too(evaluated, names):
    card = load_run(evaluated).card
    metrics = {"corner_error": CornerError(), **build_metrics(names)}
    plan = Clip("ind_test", 0, 0, 9, 1, 0, seed=0, noise_floor=False)
    for kind in ("shuffled", "codec", "model"):
        assert list(measured_in(kind, plan, metrics, card)) == ["corner_error", *names]


def test_without_a_metric_that_reads_states_there_is_no_such_row(evaluated):
    bundle = load_run(evaluated)
    config = EvaluationConfig(frames=9, device="cpu", steps_sweep=[])
    pixels = Evaluator(bundle.world_model, bundle.card, build_metrics(["mse"]), config)
    assert "truth" not in pixels.predictors


def test_metrics_that_cannot_be_measured_are_left_out_with_the_reason(evaluated):
    card = load_run(evaluated).card
    every = {**build_metrics(["mse"]), "corner_error": CornerError()}
    kept, left_out = split_available(every, card, None)
    assert list(kept) == ["mse"]
    assert left_out == {"corner_error": "no estimator reads this"}
