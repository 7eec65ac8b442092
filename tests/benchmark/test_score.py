"""Predictions that are handed in get the scores that `acwm evaluate` gives the same model."""

import dataclasses
import math
import shutil

import pytest

from acwm_benchmark.score import score_predictions
from acwm_core.evaluation.results import Summary
from tests.benchmark.conftest import evaluated
from tests.benchmark.participant import predict

ROWS = {"model", "copy"}
"""What needs no network."""


@pytest.fixture(scope="module")
def scored(predictions, tasks, truth, tmp_path_factory):
    return score(predictions, tasks, truth, tmp_path_factory.mktemp("scores"))


def score(predictions, tasks, truth, out):
    return score_predictions(predictions, tasks, data=truth, out=out, progress=False)["slide"]


def numbers(values, place=""):
    """All numbers of nested values by their place; of rows, only those that need no network."""
    if dataclasses.is_dataclass(values):
        values = {field.name: getattr(values, field.name) for field in dataclasses.fields(values)}
    if isinstance(values, dict):
        for name, value in values.items():
            if name not in ("shuffled", "codec", "metrics", "panels", "actions"):
                yield from numbers(value, f"{place}.{name}")
    elif isinstance(values, list | tuple):
        for number, value in enumerate(values):
            yield from numbers(value, f"{place}[{number}]")
    elif isinstance(values, float | int):
        yield place, float(values)


def assert_same(found, expected, least, tolerance=1e-6):
    found, expected = dict(numbers(found)), dict(numbers(expected))
    assert found.keys() == expected.keys()
    assert len(found) >= least
    for place, value in expected.items():
        close = math.isclose(found[place], value, rel_tol=tolerance, abs_tol=tolerance)
        assert close, (place, found[place], value)


def assert_evaluates_to(scored, evaluated, rows=ROWS):
    assert set(scored.splits["ind_test"].scores.rows) == rows
    assert set(evaluated.splits["ind_test"].scores.rows) == rows | {"shuffled", "codec"}
    assert scored.splits["ind_test"].counterfactual.branches > 10
    assert_same(scored.splits, evaluated.splits, least=300)
    assert_same(scored.gap, evaluated.gap, least=30)
    assert list(scored.metrics) == list(evaluated.metrics)
    assert scored.headline == evaluated.headline


def test_pictures_get_the_summary_of_evaluate(scored, run):
    assert_evaluates_to(scored, Summary.read(run))


@pytest.mark.ci
def test_a_model_with_noise_gets_the_summary_of_evaluate(noisy_run, tasks, truth, tmp_path):
    predictions = predict(noisy_run, tasks, tmp_path / "noisy", "npz")
    found = score(predictions, tasks, truth, tmp_path / "scores")
    assert_evaluates_to(found, Summary.read(noisy_run))


@pytest.mark.ci
def test_draws_get_the_summary_of_evaluate(noisy_run, tasks, truth, tmp_path):
    predictions = predict(noisy_run, tasks, tmp_path / "noisy", "npz", draws=3)
    found = score(predictions, tasks, truth, tmp_path / "scores")
    run = evaluated(shutil.copytree(noisy_run, tmp_path / "run"), truth, samples=3)
    drawn = ROWS | {"mean_of_draws", "best_of_draws"}
    assert_evaluates_to(found, Summary.read(run), drawn)
    assert found.provenance["draws"] == 3


def rms(summary, split, row):
    return math.sqrt(summary.splits[split].scores.rows[row]["mse"].value)


@pytest.mark.parametrize("kind", ["mp4", pytest.param("webm", marks=pytest.mark.ci)])
@pytest.mark.ci
def test_lossy_video_differs_by_less_than_what_is_told(kind, run, tasks, truth, scored, tmp_path):
    predictions = predict(run, tasks, tmp_path / kind, kind)
    lossy = score(predictions, tasks, truth, tmp_path / "scores")
    for split in ("ind_test", "ood_test"):
        told = rms(lossy, split, "codec")
        assert abs(rms(lossy, split, "model") - rms(scored, split, "model")) <= told
        assert 1e-4 < told < 0.1
    assert lossy.provenance["coding"] != "lossless"


@pytest.mark.ci
def test_video_without_loss_loses_nothing(run, tasks, truth, scored, tmp_path):
    predictions = predict(run, tasks, tmp_path / "mkv", "mkv")
    found = score(predictions, tasks, truth, tmp_path / "scores")
    assert rms(found, "ind_test", "codec") < 1e-7
    assert rms(found, "ind_test", "model") == pytest.approx(rms(scored, "ind_test", "model"))
