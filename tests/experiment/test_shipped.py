"""The experiments that come with acwm: the paper's tables, each with a small config for a CPU."""

import pytest

from acwm_core.recipe.compose import recipe_folder
from acwm_core.training.run_folder import trained_models
from acwm_experiment.files import read_experiment
from acwm_experiment.plan import make_plan
from tests.recipe.test_shipped import COMPARED, PAPER

CELLS = {
    "benchmark/main": 8,
    "ablations/scale": 6,
    "ablations/conditioning": 8,
    "ablations/codec": 4,
    "ablations/data": 6,
    "ablations/actions": 4,
}


def plan(name, tmp_path):
    return make_plan(read_experiment(name), tmp_path)


def test_these_are_all_of_them():
    found = [*recipe_folder().glob("ablations/*.yaml"), *recipe_folder().glob("benchmark/*.yaml")]
    names = {str(path.relative_to(recipe_folder()).with_suffix("")) for path in found}
    assert names == {
        *CELLS,
        *(f"{name}_small" for name in CELLS),
        "benchmark/zoo",
        "benchmark/planning",
    }


def test_the_zoo_has_a_model_of_every_world_on_data_of_its_own(tmp_path):
    made = plan("benchmark/zoo", tmp_path)
    assert made.experiment.groups == plan("benchmark/main", tmp_path).experiment.groups
    assert len(made.runs) == 8
    for run in made.runs:
        is_grid = run.dataset.environment == "push_sand"
        assert run.recipe.model.name == ("recurrent" if is_grid else "scene")
        assert str(run.dataset.path) == f"data/{run.dataset.environment}_zoo"
        assert run.dataset.choice.episodes is not None


def test_every_shipped_model_plans_beside_floor_and_ceiling(tmp_path):
    made = plan("planning", tmp_path)
    first, second = "The models that ship", "Model and simulator"
    tasks = [each for each in made.experiment.plans if each.table == first]
    assert {f"{each.environment}.{each.task}" for each in tasks} == {
        "push_cube.place", "stack_cube.stack", "push_rope.shape", "cloth_move.edge",
        "push_sand.gather", "pour_water.fill", "robot_arm.reach", "reacher.reach",
    }  # fmt: skip
    variants = {"push_cube_128", "push_cube_draws"}
    assert {each.environment for each in tasks} == {*trained_models()} - variants
    assert {each.rows for each in tasks} == {("model", "solution", "policy", "random", "still")}
    assert {each.seeds for each in made.experiment.plans} == {tuple(range(50))}
    others = [each for each in made.experiment.plans if each.table == second]
    assert [each.environment for each in others] == ["reacher", "push_cube"]
    assert {each.rows for each in others} == {("model", "simulator")}
    assert all(each.settings["planner"]["candidates"] == 24 for each in others)
    assert not made.runs
    assert len({each.folder for each in made.experiment.plans}) == len(tasks) + 2


def test_together_they_hold_every_recipe_of_the_paper():
    cells = {cell.recipe for name in CELLS for cell in read_experiment(name).experiment.cells}
    assert cells == {*PAPER, *COMPARED}


@pytest.mark.parametrize("name", CELLS)
def test_the_published_setting(name, tmp_path):
    made = plan(name, tmp_path)
    assert len(made.experiment.cells) == len(made.runs) == CELLS[name]
    assert made.experiment.table == name.rpartition("/")[2]
    for run in made.runs:
        assert (run.max_steps, run.gpus) == (100_000, 8)
        assert run.recipe.evaluation["protocol"] == "acwm-phys"
        assert run.dataset.choice.episodes is None
        assert run.dataset.choice.size is None


@pytest.mark.parametrize("name", CELLS)
def test_the_small_config_is_the_same_table(name, tmp_path):
    made, small = plan(name, tmp_path), plan(f"{name}_small", tmp_path)
    ours, theirs = small.experiment, made.experiment
    assert (ours.rows, ours.columns, ours.groups) == (theirs.rows, theirs.columns, theirs.groups)
    assert ours.table == theirs.table
    assert [cell.recipe for cell in ours.cells] == [cell.recipe for cell in theirs.cells]
    assert len(small.runs) == 3 * CELLS[name]
    assert {run.gpus for run in small.runs} == {0}
    assert all("small" in str(run.dataset.path) for run in small.runs)
