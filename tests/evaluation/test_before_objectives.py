"""What acwm wrote when objectives were parameters of `flow`: its runs get the same scores."""

import json
import shutil

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from tests.evaluation.test_first_release import REFERENCE, SAME, curve, values

BEFORE = REFERENCE.parent / "before_objectives"

FEW = ("splits=[ind_test]", "metrics=[mse,psnr]", "steps_sweep=[]", "counterfactual_episodes=0")
FEW += ("perturbed_episodes=0", "noise_floor_episodes=0", "videos=0")


@pytest.mark.parametrize("name", ["diffusion_forcing", "next_frame", "recurrent"])
def test_a_run_gets_the_same_scores(name, tmp_path):
    for folder in ("data", name):
        shutil.copytree(BEFORE / folder, tmp_path / folder)
    run = tmp_path / name
    before = json.loads((run / "evaluation/summary.json").read_text())["splits"]["ind_test"]
    shutil.rmtree(run / "evaluation")
    options = [f"evaluation.{option}" for option in FEW]
    words = ["evaluate", str(run), "--data", str(tmp_path / "data"), *options]
    outcome = CliRunner().invoke(main, words)
    assert outcome.exit_code == 0, outcome.output
    after = json.loads((run / "evaluation/summary.json").read_text())["splits"]["ind_test"]
    names = ("mse", "psnr")
    found, expected = (values(each["scores"]["rows"], names) for each in (after, before))
    assert {"model.psnr", "shuffled.psnr", "model.mse"} <= found.keys()
    assert found == pytest.approx({name: expected[name] for name in found}, **SAME)
    assert curve(after) == pytest.approx(curve(before), **SAME, nan_ok=True)
