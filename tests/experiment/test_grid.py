"""A grid is every combination of the values, each a run of its own in one table."""

import re

import pytest

from acwm_core.errors import RecipeError
from acwm_experiment.grid import read_grid
from acwm_experiment.plan import make_plan
from tests.experiment.parts import write_experiment

pytestmark = pytest.mark.ci

GRID = ("model.width=4,6", "training.learning_rate=1e-2,2e-2")


def test_a_row_is_named_after_its_values():
    file = read_grid("push_cube_small", ["model.layers=2,3", "+small", "objective.shift=2.0,3.0"])
    assert [cell.row for cell in file.experiment.cells] == [
        "layers=2, shift=2.0",
        "layers=2, shift=3.0",
        "layers=3, shift=2.0",
        "layers=3, shift=3.0",
    ]
    assert file.overrides == ("+small",)
    assert file.experiment.cells[1].overrides == ("model.layers=2", "objective.shift=3.0")


def test_a_list_is_one_value_and_names_that_clash_are_whole():
    file = read_grid(
        "push_cube_small",
        ["evaluation.metrics=[mse,psnr],[mse]", "data.a=1,2", "model.a=[1,2],{b: [3,4]}"],
    )
    assert [cell.row for cell in file.experiment.cells][:2] == [
        "metrics=[mse,psnr], data.a=1, model.a=[1,2]",
        "metrics=[mse,psnr], data.a=1, model.a={b: [3,4]}",
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["model.layers=2"], "a grid needs a parameter with several values"),
        (["model.layers=[2,3]"], "a grid needs a parameter with several values"),
        (["model.layers=2,2"], "give each value once"),
        (["model.layers=2,"], "none empty"),
        (["model.layers=2,3", "model.layers=4"], "model.layers is given twice"),
        ([f"training.seed={','.join(map(str, range(1001)))}"], "the grid has 1001 combinations"),
    ],
)
def test_what_is_no_grid_is_refused(words, message):
    with pytest.raises(RecipeError, match=message):
        read_grid("push_cube_small", words)


def test_data_that_is_not_there_is_asked_for(tmp_path):
    file = read_grid("push_cube_small", ["model.layers=2,3", f"data.path={tmp_path}/none"])
    with pytest.raises(RecipeError, match="make it with `acwm generate push_cube --out"):
        make_plan(file, tmp_path / "out")


def test_a_parameter_that_does_not_exist_is_refused(tmp_path):
    file = read_grid("push_cube_small", ["model.layrs=2,3"])
    with pytest.raises(RecipeError, match="no parameter 'layrs'; did you mean 'layers'"):
        make_plan(file, tmp_path / "out")


def test_every_combination_is_a_training(acwm, tmp_path):
    """That a cell is trained as it says is proven in test_files, resuming in test_running."""
    write_experiment(tmp_path)
    made = acwm("generate", "square", "--episodes", "4,2,2", "--out", "data/square", cwd=tmp_path)
    assert made[0] == 0, made
    code, out, err = acwm("experiment", "--grid", *GRID, "tiny.yaml", "--plan", cwd=tmp_path)
    assert code == 0, out + err
    rows = [f"width={w}, learning_rate={rate}" for w in (4, 6) for rate in ("1e-2", "2e-2")]
    trainings = re.findall(r"^to do    train (.*) · seed 0", out, re.MULTILINE)
    assert trainings == rows
    again = acwm("experiment", "tiny.yaml", "--grid", *GRID, "--plan", cwd=tmp_path)
    assert again == (code, out, err)
