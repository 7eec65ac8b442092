"""Experiment files: which recipes, laid out in which table, on which data, with which seeds."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, cast, get_type_hints

from acwm_core.episode import SPLITS
from acwm_core.errors import RecipeError, suggest
from acwm_core.experiment.folder import Experiment, ExperimentCell
from acwm_core.recipe.compose import find_recipe, read_recipe
from acwm_core.recipe.types import checked


@dataclass(frozen=True)
class DataChoice:
    """How a dataset is simulated if it is not there.

    Attributes:
        episodes: of train, ind_test and ood_test; None for the environment's full benchmark.
        size: of the frames, height and width; None for the environment's own.
        seed: of the dataset.
    """

    episodes: tuple[int, int, int] | None = None
    size: tuple[int, int] | None = None
    seed: int = 0


@dataclass(frozen=True)
class ExperimentFile:
    """A checked experiment file.

    Attributes:
        path: the file.
        experiment: its table, of which cells have their own overrides and no runs yet.
        overrides: for every recipe, beside the cell's own.
        data: how datasets are made, by environment or "default".
    """

    path: Path
    experiment: Experiment
    overrides: tuple[str, ...]
    data: Mapping[str, DataChoice]


@dataclass(frozen=True)
class _Sections:
    """What an experiment file may hold, with its types; `measured` of older ones is ignored."""

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
    """Read an experiment file and check what it says by itself, recipes not yet.

    Args:
        name: a path, or the name of one that comes with acwm, such as ``ablations/conditioning``.
        overrides: for every recipe, over those of the file.
        seeds: in place of those of the file.

    Raises:
        RecipeError: a missing file, no experiment, an unknown entry or a value of a wrong type.
    """
    path = find_recipe(str(name), Path())
    content = read_recipe(path)
    if "rows" not in content:
        raise RecipeError(f"{name} is no experiment: it has no `rows` (see docs/experiments.md)")
    sections = _Sections(**_typed(content, _Sections, ""))
    cells = tuple(_cells(sections.rows))
    if not cells:
        raise RecipeError("rows: there is no cell")
    chosen = tuple(sections.seeds if seeds is None else seeds)
    if not chosen or min(chosen) < 0 or len({*chosen}) < len(chosen):
        raise RecipeError("seeds: give at least one, none twice and none negative")
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


def _typed(values: Mapping[str, Any], owner: Any, prefix: str) -> dict[str, Any]:
    """The values with their types, refusing names that `owner` has not."""
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
            if cell is not None:  # left out of a table that the file extends
                recipe, *overrides = _words(f"rows.{row}.{column}".rstrip("."), cell)
                yield ExperimentCell(row, column, recipe, tuple(overrides))


def _words(where: str, cell: Any) -> list[str]:
    """The recipe and the overrides of ``push_cube conditioner=adaln``, or of the same as a list."""
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
