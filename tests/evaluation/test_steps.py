"""The curve of scores against sampling steps."""

import json
import shutil

import numpy as np
import pytest

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.results import FOLDER, SUMMARY, Summary
from acwm_core.training.run import load_run
from tests.evaluation.by_hand import rollout, squared_error, true_clip


def errors_by_hand(run, data, split, steps):
    """MSE of the first three clips, predicted one at a time."""
    world_model, episodes = load_run(run).world_model, EpisodeDataset(data, split)
    few = [episodes[index] for index in range(3)]
    made = [(rollout(world_model, each, steps=steps), true_clip(each)[0]) for each in few]
    return np.array([squared_error(*pair) for pair in made])


@pytest.mark.parametrize("split", ["ind_test", "ood_test"])
def test_the_curve_is_that_of_an_independent_computation(evaluated, data, split):
    curve = Summary.read(evaluated).splits[split].steps
    assert curve.clips == 3
    assert [point.steps for point in curve.points] == [1, 2, 6]
    errors = {steps: errors_by_hand(evaluated, data, split, steps) for steps in (1, 2, 6)}
    assert len({value.mean() for value in errors.values()}) == 3  # steps do matter here
    for point in curve.points:
        mse, psnr = point.scores["mse"].value, point.scores["psnr"].value
        assert mse == pytest.approx(errors[point.steps].mean(), rel=1e-5)
        assert psnr == pytest.approx(-10 * np.log10(errors[point.steps].mean()), abs=1e-3)
        each = -10 * np.log10(errors[point.steps]) + 10 * np.log10(errors[6])
        assert point.change["psnr"].value == pytest.approx(each.mean(), abs=1e-3)
        assert point.change["psnr"].low is None  # three episodes are too few


def test_summaries_from_before_there_was_a_curve_are_read(evaluated, tmp_path):
    folder = tmp_path / "run" / FOLDER
    folder.mkdir(parents=True)
    values = json.loads((evaluated / FOLDER / SUMMARY).read_text())
    for split in values["splits"].values():
        del split["steps"]
    (folder / SUMMARY).write_text(json.dumps(values))
    shutil.copy(evaluated / FOLDER / "episodes.parquet", folder)
    assert all(each.steps is None for each in Summary.read(tmp_path / "run").splits.values())


def test_a_curve_is_asked_for_by_name():
    assert EvaluationConfig().steps_sweep == ()
    assert EvaluationConfig(steps_sweep=(5, 1, 5)).steps_sweep == (1, 5)
