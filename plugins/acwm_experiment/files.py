"""Experiment files: what they may say, read and checked; their recipes are checked later."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, cast, get_type_hints

from acwm_core.episode import SPLITS
from acwm_core.errors import RecipeError, suggest
from acwm_core.evaluation.experiment import Experiment, ExperimentCell
from acwm_core.recipe.compose import find_recipe, read_recipe
from acwm_core.recipe.types import checked


@dataclass(frozen=True)
class DataChoice:
    """How to simulate a dataset that does not exist yet."""

    # numbers for train, ind_test and ood_test; None for the environment's full benchmark
    episodes: tuple[int, int, int] | None = None
    # height and width of the frames; None for the environment's own
    size: tuple[int, int] | None = None
    seed: int = 0  # seed of the dataset
    exploration: float = 0.0  # share of exploration in the training episodes, see `acwm generate`


@dataclass(frozen=True)
class ExperimentFile:
    """A checked experiment file."""

    path: Path  # the file
    experiment: Experiment  # its table; cells have only their own overrides and no runs yet
    overrides: tuple[str, ...]  # overrides for every recipe, besides the cell's own
    data: Mapping[str, DataChoice]  # how to make datasets, by environment or "default"
    simulates: bool = True  # whether missing datasets are simulated; otherwise they are an error


@dataclass(frozen=True)
class _Sections:
    """The entries of an experiment file and their types; `measured`, of older files, is ignored."""

    rows: dict[str, Any]
    title: str = ""
    caption: str = ""
    table: str | None = None
    overrides: list[str] = field(default_factory=list[str])
    seeds: list[int] = field(default_factory=lambda: [0])
    groups: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    data: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    measured: dict[str, Any] = field(default_factory=dict[str, Any])


def read_experiment(
    name: str | Path, overrides: Sequence[str] = (), seeds: Sequence[int] | None = None
) -> ExperimentFile:
    """Read and check an experiment file. Its recipes are not checked yet.

    Args:
        name: a path, or the name of an experiment that comes with acwm, such as
            ``ablations/conditioning``.
        overrides: further overrides for every recipe.
        seeds: training seeds instead of those in the file.

    Raises:
        RecipeError: the file is missing or not an experiment, or it has an unknown entry or a value
            of the wrong type.
    """
    path = find_recipe(str(name), Path())
    content = read_recipe(path)
    if "rows" not in content:
        raise RecipeError(f"{name} is not an experiment: it has no `rows` (docs/experiments.md)")
    sections = _Sections(**_typed(content, _Sections, ""))
    cells = tuple(_cells(sections.rows))
    if not cells:
        raise RecipeError("rows: the experiment has no runs; give a row with a recipe")
    chosen = checked_seeds(sections.seeds if seeds is None else seeds)
    rows = tuple(dict.fromkeys(cell.row for cell in cells))
    if sections.groups and [row for each in sections.groups.values() for row in each] != [*rows]:
        raise RecipeError(f"groups: list every row once, in their order: {', '.join(rows)}")
    experiment = Experiment(
        name=path.stem,
        title=sections.title or path.stem,
        caption=sections.caption,
        table=sections.table,
        rows=rows,
        columns=tuple(dict.fromkeys(cell.column for cell in cells)),
        groups={heading: tuple(members) for heading, members in sections.groups.items()},
        seeds=chosen,
        cells=cells,
    )
    data = {key: _data(key, each) for key, each in sections.data.items()}
    return ExperimentFile(path, experiment, (*sections.overrides, *overrides), data)


def checked_seeds(seeds: Sequence[int]) -> tuple[int, ...]:
    """Check training seeds.

    Raises:
        RecipeError: there are none, one is given twice, or one is negative.
    """
    if not seeds or min(seeds) < 0 or len({*seeds}) < len(seeds):
        raise RecipeError("seeds: give at least one, none twice and none negative")
    return tuple(seeds)


def _typed(values: Mapping[str, Any], owner: Any, prefix: str) -> dict[str, Any]:
    known = [each.name for each in fields(owner)]
    for name in values:
        if name not in known:
            raise RecipeError(f"unknown entry {prefix + name!r}{suggest(name, known)}")
    types = get_type_hints(owner)
    return {name: checked(prefix + name, value, types[name]) for name, value in values.items()}


def _cells(rows: Mapping[str, Any]) -> Iterator[ExperimentCell]:
    for row, content in rows.items():
        columns = cast(
            Mapping[str, Any], content if isinstance(content, Mapping) else {"": content}
        )
        for column, cell in columns.items():
            if cell is not None:  # null removes a cell of the table that the file extends
                recipe, *overrides = _words(f"rows.{row}.{column}".rstrip("."), cell)
                yield ExperimentCell(row, column, recipe, tuple(overrides))


def _words(where: str, cell: Any) -> list[str]:
    try:
        words = shlex.split(cell) if isinstance(cell, str) else checked(where, cell, list[str])
    except ValueError as error:
        raise RecipeError(f"{where}={cell}: {error}".lower()) from None
    if not words:
        raise RecipeError(f"{where} names no recipe")
    return words


def _data(key: str, values: Mapping[str, Any]) -> DataChoice:
    side = values.get("size")
    if isinstance(side, int):
        values = {**values, "size": [side, side]}
    choice = DataChoice(**_typed(values, DataChoice, f"data.{key}."))
    if choice.size and min(choice.size) < 1:
        raise RecipeError(f"data.{key}.size must be positive")
    train, *tests = choice.episodes or (1, 1)
    if train < 1 or min(tests) < 0 or not any(tests):
        raise RecipeError(
            f"data.{key}.episodes: give those of {', '.join(SPLITS)}; there must be some to train "
            "and to test on"
        )
    return choice
