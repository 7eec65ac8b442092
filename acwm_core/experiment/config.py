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

DEFAULT = "default"
"""In `data`, what holds for every environment that is not listed."""


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
        data: how datasets are made, by environment or `DEFAULT`.
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
    rows = tuple(dict.fromkeys(cell.row for cell in cells))
    chosen = tuple(sections.seeds if seeds is None else seeds)
    _require(bool(cells), "rows: there is no cell")
    _require(bool(chosen), "seeds: give at least one")
    _require(min(chosen, default=0) >= 0, "seeds: none may be negative")
    _require(len({*chosen}) == len(chosen), "seeds: one is given twice")
    experiment = Experiment(
        name=path.stem,
        title=sections.title or path.stem,
        caption=sections.caption,
        table=sections.table,
        rows=rows,
        columns=tuple(dict.fromkeys(cell.column for cell in cells)),
        groups=_groups(sections.groups, rows),
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
        if isinstance(content, Mapping):
            columns = cast(Mapping[str, Any], content)
        else:
            columns = {"": content}
        for column, cell in columns.items():
            if cell is None:  # left out of a table that the file extends
                continue
            yield ExperimentCell(row, column, *_recipe_and_overrides(f"rows.{row}.{column}", cell))


def _recipe_and_overrides(where: str, cell: Any) -> tuple[str, tuple[str, ...]]:
    """The recipe and the overrides of ``push_cube conditioner=adaln``, or of the same as a list."""
    where = where.rstrip(".")
    try:
        parts = shlex.split(cell) if isinstance(cell, str) else checked(where, cell, list[str])
    except ValueError as error:
        raise RecipeError(f"{where}={cell}: {error}".lower()) from None
    if not parts:
        raise RecipeError(f"{where} names no recipe")
    return parts[0], tuple(parts[1:])


def _groups(groups: Mapping[str, list[str]], rows: Sequence[str]) -> dict[str, tuple[str, ...]]:
    for heading, members in groups.items():
        for row in members:
            if row not in rows:
                raise RecipeError(f"groups.{heading}: unknown row {row!r}{suggest(row, rows)}")
    listed = [row for members in groups.values() for row in members]
    if groups and listed != list(rows):
        raise RecipeError("groups: list every row once, in the order of `rows`")
    return {heading: tuple(members) for heading, members in groups.items()}


def _data(key: str, values: Mapping[str, Any]) -> DataChoice:
    side = values.get("size")
    if isinstance(side, int):
        values = {**values, "size": [side, side]}
    choice = DataChoice(**_typed(values, DataChoice, f"data.{key}."))
    _require(choice.size is None or min(choice.size) > 0, f"data.{key}.size must be positive")
    counts = choice.episodes
    _require(
        counts is None or (min(counts) >= 0 and counts[0] > 0 and any(counts[1:])),
        f"data.{key}.episodes: give those of {', '.join(SPLITS)}; there must be some to train and "
        "to test on",
    )
    return choice


def _require(holds: bool, what: str) -> None:
    if not holds:
        raise RecipeError(what)
