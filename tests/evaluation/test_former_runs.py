"""What acwm wrote before is read: runs get the same scores, summaries and datasets are whole."""

import json
import shutil

import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_core.evaluation.results import Summary, write_json
from acwm_formats.check import check_dataset
from tests.evaluation.test_first_release import REFERENCE, SAME, curve, values

FORMER = REFERENCE.parent

FEW = ("splits=[ind_test]", "metrics=[mse,psnr]", "steps_sweep=[]", "counterfactual_episodes=0")
FEW += ("perturbed_episodes=0", "noise_floor_episodes=0", "ensemble_episodes=0", "videos=0")


@pytest.mark.parametrize(
    ("run", "samples"),
    [
        ("before_objectives/diffusion_forcing", 1),
        ("before_objectives/next_frame", 1),
        ("before_objectives/recurrent", 1),
        ("second_release/run", 2),
    ],
)
@pytest.mark.ci
def test_a_run_gets_the_same_scores(run, samples, tmp_path):
    release, name = run.split("/")
    for folder in ("data", name):
        shutil.copytree(FORMER / release / folder, tmp_path / folder)
    run = tmp_path / name
    before = json.loads((run / "evaluation/summary.json").read_text())["splits"]["ind_test"]
    shutil.rmtree(run / "evaluation")
    options = [f"evaluation.{option}" for option in (*FEW, f"samples={samples}")]
    words = ["evaluate", str(run), "--data", str(tmp_path / "data"), *options]
    outcome = CliRunner().invoke(main, words)
    assert outcome.exit_code == 0, outcome.output
    after = json.loads((run / "evaluation/summary.json").read_text())["splits"]["ind_test"]
    names = ("mse", "psnr")
    found, expected = (values(each["scores"]["rows"], names) for each in (after, before))
    assert {"model.psnr", "shuffled.psnr", "model.mse"} <= found.keys()
    assert found == pytest.approx({name: expected[name] for name in found}, **SAME)
    assert curve(after) == pytest.approx(curve(before), **SAME, nan_ok=True)


def test_a_summary_of_the_second_release_is_read_to_the_last_number(tmp_path):
    run = FORMER / "second_release/run"
    write_json(tmp_path / "again.json", Summary.read(run))
    before = json.loads((run / "evaluation/summary.json").read_text())
    assert {"ind_test", "ood_test"} == before["ensembles"].keys()
    again = json.loads((tmp_path / "again.json").read_text())
    assert {name: again[name] for name in before} == before


def test_a_dataset_of_the_second_release_is_sound(tmp_path):
    """Also what its card says of symmetries, which older ones do not."""
    data = shutil.copytree(FORMER / "second_release/data", tmp_path / "data")
    assert [each for each in check_dataset(data, replays=0) if each.problem] == []
    symmetries = DatasetCard.read(data).environment.symmetries
    assert len(symmetries) == 7
    again = DatasetCard.from_dict(json.loads(json.dumps(DatasetCard.read(data).to_dict())))
    assert again == DatasetCard.read(data)
