"""Names of runs: short, fit for shells and legends, and never one name for two meanings."""

from pathlib import Path

import pytest

from acwm_experiment.names import run_names
from acwm_experiment.table import ExperimentCell


def names(*cells, shared=()):
    return run_names(shared, [ExperimentCell("r", "c", r, tuple(own)) for r, *own in cells])


@pytest.mark.parametrize(
    ("recipe", "overrides", "name"),
    [
        ("push_cube", [], "push_cube"),
        ("push_cube", ["+small", "conditioner=adaln"], "push_cube+small-adaln"),
        (
            "push_cube_small",
            ["env=curling", "data.path=data/curling", "conditioner=adaln"],
            "curling-adaln",
        ),
        ("mine/push.yaml", ["data.path=data/half"], "push-half"),
        ("push_cube", ["model.layers=2", "training.learning_rate=1e-3"], "push_cube-layers2-"
         "learning_rate1e-3"),
        ("push_cube", ["model.skips=true", "training.betas=[0.9, 0.95]"], "push_cube-skips-true-"
         "betas-_0.9_0.95"),
    ],
)  # fmt: skip
def test_a_name_has_the_values_that_are_the_cells_own(recipe, overrides, name):
    assert names((recipe, *overrides)) == [name]


def test_cells_that_would_share_a_name_have_their_parameters_in_it():
    found = names(
        ("push", "env=curling", "data.path=data/a"), ("push", "env=curling", "data.path=data/b")
    )
    assert found == ["push-env-curling-data.path-data_a", "push-env-curling-data.path-data_b"]
    assert names(("push", "model.width=6"), ("push", "model.width=6")) == ["push-width6"] * 2
    assert all(Path(each).name == each for each in found)
