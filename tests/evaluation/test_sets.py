"""Metrics of sets, under several names, and of torchmetrics, through a whole evaluation."""

import numpy as np
import pytest

from acwm_core.errors import RecipeError
from acwm_core.evaluation.metric import SetMetric
from acwm_core.evaluation.results import Estimate, Summary
from acwm_core.evaluation.storage import read_scores
from acwm_core.plugins import catalog, hookimpl
from acwm_interventions.evaluate import evaluate_run
from acwm_severity.curves import read_severity
from acwm_severity.sweep import sweep_severity
from tests import tiny

SSIM = "torchmetrics.image.StructuralSimilarityIndexMeasure"


class Colours(SetMetric):
    """Squared distance of the sets' mean colours, times `scale`."""

    name = "colours"
    title = "Colour"
    group = "Colours"
    reads = "pixels"

    def __init__(self, *, scale: float = 1.0):
        self.scale = scale

    def features(self, prediction):
        clips = (prediction.video, prediction.target)
        return np.stack([clip.mean((0, 2, 3)).numpy() for clip in clips])

    def distance(self, features):
        made, true = features.mean(0)
        return self.scale * float(((made - true) ** 2).sum())

    def provenance(self):
        return {"scale": str(self.scale)}


class ColoursPlugin:
    @staticmethod
    @hookimpl
    def register_metrics(registry):
        registry.add("colours", f"{__name__}:Colours")


@pytest.fixture(scope="module")
def colourful(data, tmp_path_factory):
    if "colours" not in catalog().plugins:
        catalog().add_plugin(ColoursPlugin, "colours")
    settings = {
        "metrics": [
            "colours",
            {"name": "colours", "as": "colours_twice", "scale": 200.0},
            "mse",
            {"name": SSIM, "as": "uniform_ssim", "gaussian_kernel": False, "kernel_size": 7},
        ],
        "metric_options": {"colours": {"scale": 100.0}},
    }
    run = tiny.make_run(tmp_path_factory.mktemp("runs") / "colours", data, **settings)
    evaluate_run(run, progress=False)
    return run


def test_a_set_is_scored_as_one(colourful):
    summary, results = Summary.read(colourful), read_scores(colourful)
    for split, each in summary.splits.items():
        for row in ("model", "copy"):
            rows = [r for r in results if (r.split, r.kind) == (split, row)]
            features = np.array([r.features["colours"] for r in rows])
            assert features.shape == (len(rows), 2, 3)
            expected = 100 * ((features[:, 0] - features[:, 1]).mean(0) ** 2).sum()
            assert each.scores.rows[row]["colours"] == Estimate(pytest.approx(expected, rel=1e-4))
            assert (expected > 1e-6) == (row == "model")  # a square that stays has its colours
        assert each.scores.paired["copy"]["colours"].clips == 0
        assert set(each.horizon["model"]["colours"]) == {None}
    inside, outside = (
        summary.splits[s].scores.rows["model"]["colours"].value for s in ("ind_test", "ood_test")
    )
    assert summary.gap["model"]["colours"].value == pytest.approx(outside - inside)


def test_a_foreign_metric_of_pixels_is_one(colourful):
    infos = Summary.read(colourful).metrics
    assert list(infos) == ["colours", "colours_twice", "mse", "uniform_ssim"]
    assert {info.reads for info in infos.values()} == {"pixels"}
    assert infos["colours"] == Colours().info
    assert infos["colours"].group == "Colours"
    titles = [info.title for info in infos.values()]
    assert titles == ["Colour", "Colour twice", "MSE", "Uniform ssim"]


def test_one_metric_is_measured_in_two_ways(colourful):
    rows = Summary.read(colourful).splits["ind_test"].scores.rows
    for kind in ("model", "copy"):
        once, twice = (rows[kind][name].value for name in ("colours", "colours_twice"))
        assert twice == pytest.approx(2 * once)
    assert "truth" not in rows  # nothing reads states


def test_a_metric_of_torchmetrics_is_measured(colourful):
    scores = [each for each in read_scores(colourful) if each.kind == "codec"]
    assert all(0 < each.values["uniform_ssim"] <= 1 for each in scores)
    assert all(len(each.curves["uniform_ssim"]) == each.frames for each in scores)


def test_clips_are_ranked_by_a_metric_that_they_have(colourful):
    summary = Summary.read(colourful)
    assert summary.headline == "mse"
    assert summary.videos


def test_what_a_metric_depends_on_is_recorded(colourful):
    facts = Summary.read(colourful).provenance
    scales = {name: each["scale"] for name, each in facts["metrics"].items() if "scale" in each}
    assert scales == {"colours": "100.0", "colours_twice": "200.0"}
    assert facts["metrics"]["uniform_ssim"]["class"] == SSIM
    assert facts["evaluation"]["metric_options"] == {"colours": {"scale": 100.0}}


def test_what_a_metric_depends_on_is_recorded_with_a_sweep_too(colourful):
    words = ["evaluation.severity_episodes=2"]
    texts = ["factors.colour=90,200"]
    list(sweep_severity(colourful, texts, overrides=words, workers=0, progress=False))
    (curve,) = read_severity(colourful)
    facts = Summary.read(colourful).provenance
    for name in ("metrics", "estimator"):
        assert curve.provenance[name] == facts[name]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["evaluation.metric_options.colours.scael=2"], "did you mean 'scale'"),
        (["evaluation.metric_options.colors.scale=2"], "did you mean 'colours'"),
        (["evaluation.metric_options.colours.scale=much"], "scale"),
    ],
)
def test_wrong_options_are_refused(colourful, words, message):
    with pytest.raises(RecipeError, match=message):
        evaluate_run(colourful, overrides=words, progress=False)


def test_metrics_without_weights_are_left_out_with_a_sentence(data, tmp_path):
    settings = {"metrics": ["mse", "lpips", "fvd"], "videos": 0, "splits": ["ind_test"]}
    run = tiny.make_run(tmp_path / "run", data, **settings)
    summary = evaluate_run(run, progress=False)
    assert list(summary.metrics) == ["mse"]
    assert "metric_options.lpips.backbone" in summary.left_out["lpips"]
    assert "i3d_torchscript.pt" in summary.left_out["fvd"]
    with pytest.raises(RecipeError, match=r"none of .* can be measured"):
        evaluate_run(run, overrides=["evaluation.metrics=[lpips]"], progress=False)
