"""What counts as done, what is refused, and what is left."""

import json
import os
from dataclasses import replace

import pytest

from acwm_core.data.card import DatasetCard
from acwm_core.data.generate import generate
from acwm_core.errors import DataError, TrainingError
from acwm_core.recipe import Recipe
from acwm_experiment.files import DataChoice, read_experiment
from acwm_experiment.plan import make_plan
from acwm_experiment.runs import DatasetSpec
from acwm_experiment.steps import (
    all_progress,
    all_steps,
    dataset_is_whole,
    evaluation_overrides,
    is_evaluated,
    saved_steps,
    training_progress,
)
from acwm_experiment.table import Experiment
from acwm_report.experiment import evaluated_runs
from tests import tiny

TABLE = """
rows: {one: mine, two: mine model.width=6}
data: {default: {episodes: [8, 2, 2]}}
measured: {machine: of an older version}
"""


@pytest.fixture(scope="module", autouse=True)
def parts():
    tiny.register()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A dataset and an evaluated run of 7 steps, and the experiment that they are part of."""
    from acwm_interventions.evaluate import evaluate_run

    folder = tmp_path_factory.mktemp("made")
    data = tiny.make_dataset(folder / "data", train=8, ind_test=2, ood_test=2)
    run = tiny.make_run(folder / "out" / "runs" / "mine-0", data, metrics=["mse"], videos=0)
    evaluate_run(run, progress=False)
    recipe = Recipe.from_yaml(run / "recipe.yaml").to_dict() | {"trainer": {"max_steps": 7}}
    (folder / "mine.yaml").write_text(json.dumps(recipe))
    (folder / "table.yaml").write_text(TABLE)
    return make_plan(read_experiment(folder / "table.yaml"), folder / "out")


def test_a_dataset_counts_when_it_is_the_one_and_whole(made, tmp_path):
    dataset = made.runs[0].dataset
    assert dataset_is_whole(dataset)
    assert not dataset_is_whole(replace(dataset, path=tmp_path))
    card_says_others = {"episodes": None}
    explored = {"exploration": 0.5}
    for wrong in (
        {"episodes": (9, 2, 2)},
        {"size": (16, 16)},
        {"seed": 3},
        explored,
        card_says_others,
    ):
        choice = replace(dataset.choice, **wrong)
        assert not dataset_is_whole(replace(dataset, choice=choice))
    assert not dataset_is_whole(replace(dataset, environment="other"))


def test_a_split_that_is_missing_is_made(tmp_path):
    data = DatasetSpec(tmp_path / "data", "drift", DataChoice((2, 1, 0)))
    generate("drift", data.path, episodes={"train": 2}, workers=0, progress=False)
    assert not dataset_is_whole(data)
    generate("drift", data.path, episodes={"ind_test": 1}, workers=0, progress=False)
    assert dataset_is_whole(data)
    card = DatasetCard.read(data.path)
    replace(card, source={"kind": "numpy", "name": "mine"}, checksums={}).write(data.path)
    assert not dataset_is_whole(data)


def test_a_training_counts_by_its_weights_and_recipe(made):
    run = made.runs[0]
    assert training_progress(run) == 1
    assert training_progress(made.runs[1]) == 0
    usual = replace(run.recipe, evaluation={})
    assert "evaluation.frames=null" in evaluation_overrides(replace(run, recipe=usual))
    longer = replace(run.recipe, trainer={"max_steps": 14})
    assert training_progress(replace(run, recipe=longer)) == 0.5
    shorter = replace(run.recipe, trainer={"max_steps": 3})
    with pytest.raises(TrainingError, match=r"trainer\.max_steps was 7, is 3"):
        training_progress(replace(run, recipe=shorter))
    other = replace(
        run.recipe,
        objective=replace(
            run.recipe.objective, params={**run.recipe.objective.params, "shift": 9.0}
        ),
    )
    with pytest.raises(TrainingError, match=r"objective\.shift was \S+, is 9\.0; choose anoth"):
        training_progress(replace(run, recipe=other))


def test_damaged_weights_are_no_steps(made, tmp_path):
    assert saved_steps(made.runs[0].folder) == 7
    for content in (b"", b"\xff" * 100, b"\x02\0\0\0\0\0\0\0{}"):
        (tmp_path / "model.safetensors").write_bytes(content)
        assert saved_steps(tmp_path) == 0


def test_an_evaluation_counts_if_it_is_of_these_weights_and_settings(made, tmp_path):
    run = made.runs[0]
    assert is_evaluated(run)
    assert "evaluation.frames=9" in evaluation_overrides(run)
    assert 'evaluation.metrics=["mse"]' in evaluation_overrides(run)
    summary = run.folder / "evaluation" / "summary.json"
    values = json.loads(summary.read_text())
    del values["provenance"]["evaluation"]["seed"]  # by a version that had no such setting
    summary.write_text(json.dumps(values))
    assert is_evaluated(run)
    others = replace(run.recipe, evaluation={**run.recipe.evaluation, "seed": 4})
    assert not is_evaluated(replace(run, recipe=others))
    assert "evaluation.seed=4" in evaluation_overrides(replace(run, recipe=others))
    longer = replace(run.recipe, trainer={"max_steps": 14})
    assert not is_evaluated(replace(run, recipe=longer))
    weights = run.folder / "model.safetensors"
    before = weights.stat().st_mtime_ns
    os.utime(weights, ns=(before, summary.stat().st_mtime_ns + 1))
    assert not is_evaluated(run)
    os.utime(weights, ns=(before, before))
    assert is_evaluated(run)


def test_only_what_is_missing_is_left(made):
    steps = all_steps(made)
    left = [step.name for step in steps if all_progress(steps, made)[step.name] < 1]
    assert left == ["train-mine-width6-0", "evaluate-mine-width6-0", "report"]
    made.experiment.write(made.folder)
    assert evaluated_runs(made.folder) == [made.runs[0].folder]
    (made.folder / "experiment.json").write_text('{"format": 1}')
    with pytest.raises(DataError, match=r"experiment\.json is damaged"):
        Experiment.read(made.folder)
    with pytest.raises(DataError, match="holds no experiment"):
        evaluated_runs(made.folder / "runs")


def test_data_that_nothing_needs_any_more_is_not_made_again(made):
    gone = DatasetSpec(made.folder / "gone", "drift", DataChoice((8, 2, 2)))
    runs = tuple(replace(run, dataset=gone) for run in made.runs)
    first, both = replace(made, runs=runs[:1]), replace(made, runs=runs)
    for plan, done in ((first, True), (both, False)):
        steps = all_steps(plan)
        assert (all_progress(steps, plan)[steps[0].name] == 1) == done
