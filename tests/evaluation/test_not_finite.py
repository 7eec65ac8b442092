"""A prediction that is not finite counts against the model wherever scores are shown."""

import json
import math
import shutil

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from safetensors.torch import load_file, save_file

from acwm_core.cli.main import main
from acwm_core.errors import DataError, TrainingError
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.results import FOLDER, SUMMARY, Summary
from acwm_core.evaluation.storage import read_scores
from acwm_core.model.world_model import WorldModel
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder
from acwm_interventions.evaluate import evaluate_run
from acwm_report.boards import boards_of
from acwm_report.comparison import compare_runs
from acwm_report.page import write_report
from tests import tiny


def copied(run, to):
    shutil.copytree(run, to)
    return to


@pytest.fixture(scope="module")
def failing(data, tmp_path_factory):
    """An evaluated run whose model predicts one NaN in one pixel of its first test clips."""
    folder = tiny.make_run(tmp_path_factory.mktemp("runs") / "failing", data, **tiny.SWEEP)
    healthy = Evaluator.predict

    def predict(self, truths, kinds, donated=(), draws=0):
        made = healthy(self, truths, kinds, donated, draws)
        if len(kinds) > 1:
            first = next(each for each in made if each.kind == "model")
            with torch.inference_mode():
                first.video[5, 1, 3, 4] = torch.nan
        return made

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Evaluator, "predict", predict)
        evaluate_run(folder, progress=False)
    return folder


def test_one_nan_in_one_pixel_makes_the_whole_score_infinitely_bad(failing):
    summary = Summary.read(failing)
    scores = summary.splits["ind_test"].scores
    assert scores.failed == {"model": 1}
    assert scores.rows["model"]["psnr"].value == -math.inf
    assert scores.rows["model"]["mse"].value == math.inf
    assert scores.rows["model"]["ssim"].value == -math.inf
    assert np.isfinite(scores.rows["copy"]["psnr"].value)
    assert np.isfinite(scores.rows["shuffled"]["psnr"].value)
    assert scores.paired["copy"]["psnr"].difference.value == -math.inf
    assert scores.paired["copy"]["psnr"].clips == scores.clips
    clip = next(r for r in read_scores(failing) if r.failed)
    assert (clip.kind, clip.values["psnr"], clip.values["mse"]) == ("model", -math.inf, math.inf)
    others = [r for r in read_scores(failing) if not r.failed]
    assert all(np.isfinite(r.values["psnr"]) for r in others)


def test_json_without_a_reader_of_ours_tells_it_too(failing):
    text = (failing / FOLDER / SUMMARY).read_text()
    values = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert values["splits"]["ind_test"]["scores"]["rows"]["model"]["psnr"]["value"] == "-Infinity"


def test_every_table_shows_it(failing, tmp_path, capsys):
    from acwm_report.terminal import print_summary

    print_summary(Summary.read(failing))
    shown = capsys.readouterr().out
    assert "model: 1 of 5 predictions are not finite: their scores are infinitely bad" in shown
    assert "-∞" in shown
    page = write_report([failing], tmp_path / "page.html").read_text()
    assert "1 of 5 predictions are not finite" in page
    assert "−∞" in page


def test_it_ranks_last_on_a_leaderboard(failing, evaluated):
    entries = {"a failing one": Summary.read(failing), "healthy": Summary.read(evaluated)}
    (board,) = boards_of(entries)
    assert [row.title for row in board.table.rows] == ["healthy", "a failing one"]
    assert "not finite" in board.table.rows[1].note
    assert board.table.rows[1].cells[0].text in ("∞", "−∞")


def test_a_comparison_says_that_the_healthy_model_is_better(failing, evaluated, tmp_path):
    found = compare_runs([failing, evaluated], metrics=["psnr", "mse"], splits=["ind_test"])
    for each in found.differences:
        assert math.isinf(each.difference)
        assert each.winner == evaluated.name
        assert each.p is None
        assert each.episodes == 5
    other_way = compare_runs([evaluated, failing], metrics=["psnr"], splits=["ind_test"])
    assert other_way.differences[0].winner == evaluated.name
    words = ["compare", str(failing), str(evaluated), "--out", str(tmp_path / "found.json")]
    shown = CliRunner().invoke(main, words)
    assert "∞" in shown.output
    assert '"difference": "Infinity"' in (tmp_path / "found.json").read_text()


def test_weights_that_are_not_finite_are_refused(evaluated, tmp_path):
    folder = RunFolder(copied(evaluated, tmp_path / "nan"))
    with torch.no_grad():
        weights = load_file(folder.weights)
    metadata = {"acwm": json.dumps({"format": 1, "step": 3, "codec": None})}
    name = next(iter(weights))
    weights[name].view(-1)[0] = torch.nan
    save_file(weights, folder.weights, metadata)
    with pytest.raises(DataError, match=f"weights that are not finite \\({name}\\)"):
        load_run(folder.path)


def test_a_rollout_that_is_not_finite_is_refused(evaluated, tmp_path, monkeypatch):
    from acwm_dream import rollout

    def diverging(model, given, actions, **settings):
        yield given.expand(-1, 4, -1, -1, -1)
        yield torch.full((1, 5, *given.shape[2:]), torch.nan)

    monkeypatch.setattr(WorldModel, "rollout_chunks", diverging)
    with pytest.raises(TrainingError, match="not finite from frame 4 on"):
        rollout.rollout_run(evaluated, tmp_path / "out.mp4")
    assert not (tmp_path / "out.mp4").exists()


def test_scores_of_old_have_no_counts_and_are_read(evaluated, tmp_path):
    folder = copied(evaluated, tmp_path / "old")
    path = folder / FOLDER / SUMMARY
    values = json.loads(path.read_text())
    for split in values["splits"].values():
        for key in ("failed", "undefined"):
            del split["scores"][key]
    path.write_text(json.dumps(values))
    assert Summary.read(folder).splits["ind_test"].scores.failed == {}


def test_what_is_not_defined_is_counted(evaluated):
    counts = Summary.read(evaluated).splits["ind_test"].scores.undefined
    model = [r for r in read_scores(evaluated) if (r.split, r.kind) == ("ind_test", "model")]
    by_hand = {n: sum(math.isnan(r.values[n]) for r in model) for n in model[0].values}
    assert counts == {name: count for name, count in by_hand.items() if count}
