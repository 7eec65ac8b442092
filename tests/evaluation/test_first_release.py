"""What acwm 0.1 wrote: its data, run and results are read, and the run gets the same scores."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.evaluation.results import Summary
from acwm_formats.check import check_dataset

REFERENCE = Path(__file__).parents[1] / "reference" / "first_release"

OPTIONS = [
    f"evaluation.{option}"
    for option in (
        "splits=[ood_test]",
        "steps_sweep=[1,2]",
        "sweep_episodes=2",
        "counterfactual_episodes=2",
        "perturbed_episodes=2",
        "videos=0",
        "noise_floor_episodes=2",
    )
]

SAME = {"rel": 2e-3, "abs": 2e-4}
"""Processors round differently, and a network carries that on."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    copy = tmp_path_factory.mktemp("first") / "release"
    shutil.copytree(REFERENCE, copy)
    return copy


@pytest.fixture(scope="module")
def before():
    return json.loads((REFERENCE / "run/evaluation/summary.json").read_text())


def test_its_dataset_is_sound(folder):
    found = [result for result in check_dataset(folder / "data", replays=0) if result.problem]
    assert found == []


def test_its_episodes_are_simulated_again(folder):
    episodes = EpisodeDataset(folder / "data", "ood_test")
    spec = EpisodeSpec("push_cube", "ood_test", 1, 3, {}, {"size": 64})
    environment = make_environment(spec.environment, spec.options)
    again, kept = simulate(environment, spec), episodes[1]
    environment.close()
    assert again.factors == kept.factors
    start = slice(0, 8)  # later frames may part on another processor
    np.testing.assert_allclose(again.actions[start], kept.actions[start], atol=1e-4)
    assert np.abs(again.video[start].astype(int) - kept.video[start]).mean() < 0.1


def test_its_summary_is_read(folder, before):
    summary = Summary.read(folder / "run")
    assert summary.headline == "psnr"
    assert summary.metrics["psnr"].unit == "dB"
    found = summary.splits["ind_test"].counterfactual
    assert found is not None
    expected = before["splits"]["ind_test"]["counterfactual"]
    assert found.gain == expected["gain"]


def test_its_run_is_reported(folder, tmp_path):
    page = tmp_path / "report.html"
    outcome = CliRunner().invoke(main, ["report", str(folder / "run"), "--out", str(page)])
    assert outcome.exit_code == 0, outcome.output
    assert "23.26" in page.read_text()  # psnr_mean in distribution


@pytest.mark.ci
def test_its_run_gets_the_same_scores(folder, before):
    run = folder / "run"
    data = ["--data", str(folder / "data")]
    arguments = ["evaluate", str(run), *data, "--overwrite", *OPTIONS]
    outcome = CliRunner().invoke(main, arguments)
    assert outcome.exit_code == 0, outcome.output
    after = json.loads((run / "evaluation/summary.json").read_text())
    assert after["left_out"] == before["left_out"]
    expected, found = (each["splits"]["ood_test"] for each in (before, after))
    same = [name for name, info in after["metrics"].items() if info["definition"] == 1]
    assert {"psnr", "mask_iou"} <= {*same}
    assert values(found["scores"]["rows"], same) == pytest.approx(
        values(expected["scores"]["rows"], same), **SAME
    )
    assert found["scores"]["shares"]["model"]["position_error"] <= 1
    assert curve(found) == pytest.approx(curve(expected), **SAME, nan_ok=True)
    responses = [each["counterfactual"]["rows"]["model"]["response"] for each in (found, expected)]
    assert responses[0]["value"] == pytest.approx(responses[1]["value"], **SAME)


def values(rows, names):
    """Scores by row and metric, of those named, without their intervals."""
    return {
        f"{row}.{metric}": estimate["value"]
        for row, metrics in rows.items()
        for metric, estimate in metrics.items()
        if metric in names and estimate["value"] is not None
    }


def curve(split):
    """The model's PSNR frame by frame; the first was given."""
    return np.array(split["horizon"]["model"]["psnr"][1:], float)
