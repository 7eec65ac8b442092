"""Grids: an experiment that runs a recipe with every combination of some values."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from acwm_core.errors import RecipeError
from acwm_core.recipe.compose import find_recipe
from acwm_experiment.files import ExperimentFile, checked_seeds
from acwm_experiment.table import Experiment, ExperimentCell

COMMA = re.compile(r",(?![^\[{(]*[\]})])")
"""A comma that separates values, not one within brackets."""

MAX_CELLS = 1000
"""Largest number of combinations; nobody starts more on purpose."""


def read_grid(
    recipe: str | Path, overrides: Sequence[str], seeds: Sequence[int] | None = None
) -> ExperimentFile:
    """An experiment with one row for each combination of values, named after its values.

    Args:
        recipe: a file, or the name of a recipe that comes with acwm.
        overrides: overrides as in `acwm fit`. Those with several values, such as
            ``model.layers=2,3``, make the rows; the others apply to all rows.
        seeds: training seeds; 0 by default.

    Raises:
        RecipeError: there is no such recipe, no parameter has several values, a parameter is given
            twice, or there are too many combinations. Whether the parameters exist is checked
            later, when the plan is made.
    """
    path = find_recipe(str(recipe), Path())
    axes = {key: values for key, values in map(_axis, overrides) if len(values) > 1}
    fixed = tuple(each for each in overrides if len(_axis(each)[1]) < 2)
    if not axes:
        raise RecipeError(
            "a grid needs a parameter with several values, as in model.layers=2,3 (and a list is "
            "one value: [2,3])"
        )
    keys = Counter(_axis(each)[0] for each in overrides if not each.startswith("+"))
    for key, count in keys.items():
        if key in axes and count > 1:
            raise RecipeError(f"{key} is given twice: list its values once, as in {key}=1,2,3")
    for key, values in axes.items():
        if "" in values or len({*values}) < len(values):
            raise RecipeError(f"{key}={','.join(values)}: give each value once, and none empty")
    combinations = [*itertools.product(*axes.values())]
    if len(combinations) > MAX_CELLS:
        raise RecipeError(f"the grid has {len(combinations)} combinations; at most {MAX_CELLS}")
    names = _short([*axes])
    cells = tuple(
        ExperimentCell(
            row=", ".join(f"{name}={value}" for name, value in zip(names, values, strict=True)),
            column="",
            recipe=str(path),
            overrides=tuple(f"{key}={value}" for key, value in zip(axes, values, strict=True)),
        )
        for values in combinations
    )
    experiment = Experiment(
        name=f"{path.stem}_grid",
        title=f"{path.stem}: {' × '.join(axes)}",
        caption="",
        table=None,
        rows=tuple(cell.row for cell in cells),
        columns=("",),
        groups={},
        seeds=checked_seeds((0,) if seeds is None else seeds),
        cells=cells,
    )
    return ExperimentFile(path, experiment, fixed, data={}, simulates=False)


def _axis(override: str) -> tuple[str, list[str]]:
    key, _, text = override.partition("=")
    return key, [value.strip() for value in COMMA.split(text)]


def _short(keys: list[str]) -> list[str]:
    """Parameter names without their sections, unless these are needed to tell them apart."""
    last = [key.rpartition(".")[2] for key in keys]
    return [short if last.count(short) == 1 else key for short, key in zip(last, keys, strict=True)]
