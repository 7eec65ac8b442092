"""Experiment files: what is wrong with one is a sentence, before anything is loaded or written."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from acwm_core.cli.main import main
from acwm_core.errors import AcwmError
from acwm_experiment.files import DataChoice, read_experiment
from acwm_experiment.plan import make_plan
from acwm_experiment.steps import all_steps
from acwm_experiment.table import Experiment

GOOD = """
title: Pushing
overrides: [+small]
rows:
  one: {cube: push_cube, rope: push_rope model.layers=2}
  two: {cube: [push_cube, conditioner=cross_attention]}
groups: {both: [one, two]}
seeds: [0, 3]
data:
  default: {size: 64, episodes: [8, 2, 2]}
  push_rope: {size: [32, 64], seed: 5, exploration: 0.4}
"""


def plan(tmp_path, text=GOOD, overrides=(), seeds=None, runs=None):
    file = tmp_path / "pushing.yaml"
    file.write_text(text)
    found = read_experiment(file, overrides, seeds)
    return make_plan(found, tmp_path / "out", runs)


def test_a_file_becomes_a_table_of_runs(tmp_path):
    made = plan(tmp_path)
    table = made.experiment
    assert (table.rows, table.columns, table.seeds) == (("one", "two"), ("cube", "rope"), (0, 3))
    cube, rope, _ = (run.dataset for run in made.runs[:3])
    assert (str(cube.path), str(rope.path)) == ("data/push_cube_small", "data/push_rope_small")
    assert cube.choice == DataChoice((8, 2, 2), (64, 64))
    assert rope.choice == DataChoice(None, (32, 64), 5, 0.4)
    names = [run.folder.name for run in made.runs]
    assert names[:3] == [
        "push_cube+small-0", "push_rope+small-layers2-0", "push_cube+small-cross_attention-0",
    ]  # fmt: skip
    assert [run.recipe.training["seed"] for run in made.runs] == [0] * 3 + [3] * 3
    assert made.runs[1].recipe.model.params["layers"] == 2
    assert made.runs[1].arguments == ("push_rope", "+small", "model.layers=2", "training.seed=0")
    assert made.runs[0].title == "both · one · cube · seed 0"


def test_overrides_and_seeds_of_the_command_line_come_last(tmp_path):
    made = plan(tmp_path, overrides=["trainer.max_steps=7", "conditioner=adaln"], seeds=[9])
    assert {run.max_steps for run in made.runs} == {7}
    assert [run.recipe.training["seed"] for run in made.runs] == [9] * 3
    assert made.runs[2].recipe.conditioner.name == "cross_attention"  # the cell's own is nearer


def test_commands_are_those_that_one_would_type(tmp_path):
    commands = {step.name: " ".join(step.command) for step in all_steps(plan(tmp_path))}
    assert commands["simulate-data_push_cube_small"] == (
        "generate push_cube --out data/push_cube_small --episodes 8,2,2 --size 64x64"
    )
    options = "--size 32x64 --seed 5 --exploration 0.4"
    assert commands["simulate-data_push_rope_small"].endswith(options)
    assert commands["train-push_cube+small-3"] == (
        f"fit push_cube +small training.seed=3 --out {tmp_path}/out/runs/push_cube+small-3 "
        "resume=auto"
    )
    assert len(commands) == 2 + 6 + 6 + 1


def test_equal_cells_are_one_run(tmp_path):
    text = GOOD.replace("two: {cube: [push_cube, conditioner=cross_attention]}", "two: push_cube")
    made = plan(tmp_path, text, runs=tmp_path / "shared")
    assert len(made.runs) == 4
    cells = made.experiment.cells
    assert cells[2].title == "two"
    assert cells[2].runs == cells[0].runs
    assert made.runs[0].folder.parent == tmp_path / "shared"


def test_a_table_that_is_extended_may_lose_cells_and_rows(tmp_path):
    (tmp_path / "base.yaml").write_text(GOOD.replace("groups: {both: [one, two]}", ""))
    made = plan(tmp_path, "extends: base.yaml\nrows: {one: {rope: null}, two: null}")
    assert (made.experiment.rows, made.experiment.columns) == (("one",), ("cube",))


def test_what_is_written_is_read_again(tmp_path):
    made = plan(tmp_path).experiment
    (tmp_path / "out").mkdir()
    made.write(tmp_path / "out")
    assert Experiment.read(tmp_path / "out") == made
    assert str(tmp_path) not in (tmp_path / "out" / "experiment.json").read_text()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("overrides:", "overides:", "unknown entry 'overides'; did you mean 'overrides'?"),
        ("rows:", "cells:", "it has no `rows`"),
        ("push_rope model", "push_roap model", "one · rope: there is no recipe 'push_roap'; did "),
        ("layers=2", "layers=two", "model.layers=two: expected int"),
        ("[+small]", "[+smal]", "there is no overlay '+smal'; did you mean '+small'?"),
        ("[push_cube,", "[push_cube, env=push_cub,", "unknown environment 'push_cub'; did you "),
        ("[0, 3]", "[0, a]", "seeds=[0, \"a\"]: expected [int, …]"),
        ("[0, 3]", "[1, 1]", "seeds: give at least one, none twice and none negative"),
        ("[0, 3]", "[-1]", "seeds: give at least one, none twice and none negative"),
        ("[0, 3]", "[]", "seeds: give at least one, none twice and none negative"),
        ("[one, two]", "[one, tow]", "groups: list every row once, in their order: one, two"),
        ("[one, two]", "[two]", "groups: list every row once, in their order: one, two"),
        ("[8, 2, 2]", "[8, 0, 0]", "data.default.episodes: give those of train, ind_test, ood_t"),
        ("[8, 2, 2]", "[8, 2]", "data.default.episodes=[8, 2]: expected [int, int, int]"),
        ("size: 64", "size: big", "data.default.size=big: expected [int, int] or null"),
        ("size: 64", "sizes: 64", "unknown entry 'data.default.sizes'; did you mean 'size'?"),
        ("push_cube, rope", "'', rope", "rows.one.cube names no recipe"),
        ("push_cube, rope", "'a \"b', rope", "no closing quotation"),
        ("push_cube, rope", "push_cube trainer.max_steps=-1, rope", "set trainer.max_steps"),
        ("push_cube, rope", "push_cube env=null data.path=nil, rope", "there is no dataset in nil"),
    ],
)  # fmt: skip
def test_mistakes_are_one_sentence(old, new, message, tmp_path):
    assert old in GOOD
    with pytest.raises(AcwmError) as caught:
        plan(tmp_path, GOOD.replace(old, new, 1))
    assert message in str(caught.value)
    assert not (tmp_path / "out").exists()


def test_two_recipes_of_one_name_are_told_apart(tmp_path):
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "push_cube.yaml").write_text("extends: robot_arm\n")
    with pytest.raises(AcwmError, match=r"both be push_cube\+small-0, but their recipes dif"):
        plan(tmp_path, GOOD.replace("[push_cube, conditioner=cross_attention]", "other/push_cube"))


def test_recipes_beside_the_file_are_found_from_elsewhere(tmp_path):
    (tmp_path / "mine.yaml").write_text("extends: push_cube\nobjective: {shift: 2.0}\n")
    made = plan(tmp_path, "rows: {all: mine}")
    assert made.runs[0].arguments[0] == str(tmp_path / "mine.yaml")
    assert made.runs[0].recipe.objective.params["shift"] == 2.0
    assert made.experiment.title == "pushing"


def test_the_command_line_ends_with_a_sentence_and_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words, message in (
        (["ablations/conditoning"], "did you mean 'ablations/conditioning'?"),
        (["push_cube"], "push_cube is not an experiment: it has no `rows`"),
        (["ablations/scale", "--seeds", "0,b"], "'--seeds': 0,b: give a number"),
        (["ablations/scale", "executor.sbatch=--time=1"], "executor.sbatch needs --executor"),
        (["ablations/scale", "model.layer=2"], "has no parameter 'layer'; did you mean 'layers'?"),
        (["ablations/scale", "--executor", "slurm"], "this machine has no sbatch"),
        (["ablations/scale", "--executor", "processes"], "'processes' takes no jobs that outlive"),
    ):
        monkeypatch.setenv("PATH", str(tmp_path))
        result = CliRunner().invoke(main, ["experiment", *words], standalone_mode=True)
        assert result.exit_code == 2, result.output
        assert message in result.output
    assert not list(Path().iterdir())
