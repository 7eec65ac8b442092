"""What counts as done, what is refused, and how long the rest takes."""

import json
import os
from dataclasses import replace

import pytest

from acwm_core.data.card import DatasetCard
from acwm_core.data.generate import generate
from acwm_core.errors import DataError, TrainingError
from acwm_core.experiment.config import DataChoice, read_experiment
from acwm_core.experiment.estimate import estimate
from acwm_core.experiment.folder import Experiment, ExperimentFolder, evaluated_runs
from acwm_core.experiment.ledger import Ledger
from acwm_core.experiment.plan import Dataset, make_plan
from acwm_core.experiment.states import (
    NOTHING,
    State,
    dataset_state,
    evaluation_overrides,
    evaluation_state,
    saved_steps,
    training_state,
)
from acwm_core.experiment.steps import all_steps, states_of
from acwm_core.recipe import Recipe
from tests.evaluation import tiny

TABLE = """
rows: {one: mine, two: mine model.width=6}
data: {default: {episodes: [8, 2, 2]}}
measured:
  machine: a slow one
  episode: {drift: 2.0}
  step: {mine: 0.5}
  evaluation: {default: 60}
"""


@pytest.fixture(scope="module", autouse=True)
def parts():
    tiny.register()


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A dataset and an evaluated run of 7 steps, and the experiment that they are part of."""
    from acwm_core.evaluation.evaluate import evaluate_run

    folder = tmp_path_factory.mktemp("made")
    data = tiny.make_dataset(folder / "data", train=8, ind_test=2, ood_test=2)
    run = tiny.make_run(folder / "out" / "runs" / "mine-0", data, metrics=["mse"], videos=0)
    evaluate_run(run, progress=False)
    recipe = Recipe.from_yaml(run / "recipe.yaml").to_dict() | {"trainer": {"max_steps": 7}}
    (folder / "mine.yaml").write_text(json.dumps(recipe))
    (folder / "table.yaml").write_text(TABLE)
    return make_plan(read_experiment(folder / "table.yaml"), ExperimentFolder(folder / "out"))


def test_a_dataset_counts_when_it_is_the_one_and_whole(made, tmp_path):
    dataset = made.datasets[0]
    assert dataset_state(dataset).done
    assert dataset_state(replace(dataset, path=tmp_path)) == NOTHING
    for wrong, message in (
        ({"episodes": (9, 2, 2)}, "train has 8 episodes, not 9"),
        ({"size": (16, 16)}, "frames are 32×32, not 16×16"),
        ({"seed": 3}, "its seed is 0, not 3"),
        ({"episodes": None}, "ind_test has 2 episodes, not 4; ood_test has 2"),  # as its card says
    ):
        with pytest.raises(DataError, match=message):
            dataset_state(replace(dataset, choice=replace(dataset.choice, **wrong)))
    with pytest.raises(DataError, match="it is of drift, not other"):
        dataset_state(replace(dataset, environment="other"))


def test_a_split_that_is_missing_is_made(tmp_path):
    data = Dataset(tmp_path / "data", "drift", DataChoice((2, 1, 0)))
    generate("drift", data.path, episodes={"train": 2}, workers=0, progress=False)
    assert not dataset_state(data).done
    generate("drift", data.path, episodes={"ind_test": 1}, workers=0, progress=False)
    assert dataset_state(data).done
    card = DatasetCard.read(data.path)
    replace(card, source={"kind": "numpy", "name": "mine"}, checksums={}).write(data.path)
    assert not dataset_state(data).done


def test_a_training_counts_by_its_weights_and_recipe(made):
    run = made.runs[0]
    assert training_state(run) == State(True, 1.0)
    assert training_state(made.runs[1]) == NOTHING
    usual = replace(run.recipe, evaluation={})
    assert "evaluation.frames=null" in evaluation_overrides(replace(run, recipe=usual))
    longer = replace(run.recipe, trainer={"max_steps": 14})
    assert training_state(replace(run, recipe=longer)) == State(False, 0.5)
    shorter = replace(run.recipe, trainer={"max_steps": 3})
    with pytest.raises(TrainingError, match=r"trainer\.max_steps was 7, is 3"):
        training_state(replace(run, recipe=shorter))
    other = replace(run.recipe, flow={**run.recipe.flow, "shift": 9.0})
    with pytest.raises(TrainingError, match=r"flow\.shift was \S+, is 9\.0; choose anoth"):
        training_state(replace(run, recipe=other))


def test_damaged_weights_are_no_steps(made, tmp_path):
    assert saved_steps(made.runs[0].folder) == 7
    for content in (b"", b"\xff" * 100, b"\x02\0\0\0\0\0\0\0{}"):
        (tmp_path / "model.safetensors").write_bytes(content)
        assert saved_steps(tmp_path) == 0


def test_an_evaluation_counts_if_it_is_of_these_weights_and_settings(made, tmp_path):
    run = made.runs[0]
    assert evaluation_state(run).done
    assert "evaluation.frames=9" in evaluation_overrides(run)
    assert 'evaluation.metrics=["mse"]' in evaluation_overrides(run)
    summary = run.folder / "evaluation" / "summary.json"
    values = json.loads(summary.read_text())
    del values["provenance"]["evaluation"]["seed"]  # by a version that had no such setting
    summary.write_text(json.dumps(values))
    assert evaluation_state(run).done
    others = replace(run.recipe, evaluation={**run.recipe.evaluation, "seed": 4})
    assert not evaluation_state(replace(run, recipe=others)).done
    assert "evaluation.seed=4" in evaluation_overrides(replace(run, recipe=others))
    longer = replace(run.recipe, trainer={"max_steps": 14})
    assert not evaluation_state(replace(run, recipe=longer)).done
    weights = run.folder / "model.safetensors"
    before = weights.stat().st_mtime_ns
    os.utime(weights, ns=(before, summary.stat().st_mtime_ns + 1))
    assert not evaluation_state(run).done
    os.utime(weights, ns=(before, before))
    assert evaluation_state(run).done


def test_only_what_is_missing_is_left(made):
    steps = all_steps(made)
    left = [step.name for step in steps if not states_of(steps, made)[step.name].done]
    assert left == ["train-mine,model.width=6-0", "evaluate-mine,model.width=6-0", "report"]
    made.experiment.write(made.folder.path)
    assert evaluated_runs(made.folder.path) == [made.runs[0].folder]
    (made.folder.path / "experiment.json").write_text('{"format": 1}')
    with pytest.raises(DataError, match=r"experiment\.json is damaged"):
        Experiment.read(made.folder.path)
    with pytest.raises(DataError, match="holds no experiment"):
        evaluated_runs(made.folder.path / "runs")


def test_data_that_nothing_needs_any_more_is_not_made_again(made):
    gone = Dataset(made.folder.path / "gone", "drift", DataChoice((8, 2, 2)))
    runs = tuple(replace(run, dataset=gone) for run in made.runs)
    first, both = replace(made, runs=runs[:1]), replace(made, runs=runs)
    for plan, done in ((first, True), (both, False)):
        steps = all_steps(plan)
        assert states_of(steps, plan)[steps[0].name].done == done


def test_the_time_that_is_left(made, tmp_path):
    """Worked out by hand: 12 episodes, 2 × 7 steps, 2 evaluations of 60 s."""
    steps = all_steps(made)
    measured, ledger = made.file.measured, Ledger(tmp_path)
    states = {step.name: NOTHING for step in steps}

    def left(**settings):
        return estimate(steps, states, ledger, measured, **settings)

    assert left().seconds == 24 + 7 + 120
    assert left(jobs=2, cores=4).seconds == 24 / 4 + (7 + 120) / 2
    assert (left().measured, left().unknown) == (False, 0)
    states["train-mine-0"] = State(False, 3 / 7)
    assert left().seconds == pytest.approx(24 + 5.5 + 120)
    states["train-mine-0"] = states["evaluate-mine-0"] = State(True, 1.0)
    ledger.seconds("train-mine-0").write_text("7.0")  # twice as long as expected
    assert left().seconds == 24 + 7 + 60
    assert left().measured
    none = estimate(steps, states, Ledger(tmp_path / "no"), replace(measured, step={}, episode={}))
    assert (none.seconds, none.unknown) == (60, 2)
