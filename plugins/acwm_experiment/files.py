"""Experiment files: what they may say, read and checked; their recipes are checked later."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, cast, get_type_hints

import click

from acwm_core.cli.arguments import seed_numbers
from acwm_core.env.episode import SPLITS
from acwm_core.errors import RecipeError, suggest
from acwm_core.recipe.compose import find_recipe, read_recipe
from acwm_core.recipe.trust import recipes_are_trusted, refuse_code
from acwm_core.recipe.types import checked
from acwm_experiment.table import Experiment, ExperimentCell


@dataclass(frozen=True)
class DataChoice:
    """How to simulate a dataset that does not exist yet."""

    # numbers for train, ind_test and ood_test; None for the environment's full benchmark
    episodes: tuple[int, int, int] | None = None
    # height and width of the frames; None for the environment's own
    size: tuple[int, int] | None = None
    seed: int = 0  # seed of the dataset
    exploration: float = 0.0  # share of exploration in the training episodes, see `acwm generate`
    shift: float = 0.0  # of one dimension of their actions


@dataclass(frozen=True)
class TaskChoice:
    """A row of a table of `plans`: a task to solve with a model, for `acwm plan`."""

    table: str  # title of the table
    row: str  # its label
    model: str  # title of a cell of the experiment, or a run folder or trained model
    task: str  # name of a task of the model's environment
    overrides: tuple[str, ...]  # settings of planning, beside those that the task declares
    seeds: tuple[int, ...]  # numbers of the episodes
    rows: tuple[str, ...]  # what chooses the actions
    videos: int  # number of episodes with a video


@dataclass(frozen=True)
class ExperimentFile:
    """A checked experiment file."""

    path: Path  # the file
    experiment: Experiment  # its table; cells have only their own overrides and no runs yet
    overrides: tuple[str, ...]  # overrides for every recipe, besides the cell's own
    data: Mapping[str, DataChoice]  # how to make datasets, by environment or "default"
    tasks: tuple[TaskChoice, ...] = ()  # to solve by planning, table by table
    simulates: bool = True  # whether missing datasets are simulated; otherwise they are an error


@dataclass(frozen=True)
class _Sections:
    """The entries of an experiment file and their types; `measured`, of older files, is ignored."""

    rows: dict[str, Any] = field(default_factory=dict[str, Any])
    plans: dict[str, dict[str, Any] | None] = field(
        default_factory=dict[str, dict[str, Any] | None]
    )
    title: str = ""
    caption: str = ""
    table: str | None = None
    overrides: list[str] = field(default_factory=list[str])
    seeds: list[int] = field(default_factory=lambda: [0])
    groups: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    data: dict[str, dict[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    measured: dict[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True)
class _Tasks:
    """The entries of a table of `plans` and their types."""

    tasks: dict[str, Any]
    seeds: str | list[int] = "0"
    rows: list[str] = field(default_factory=lambda: ["model"])
    overrides: list[str] = field(default_factory=list[str])
    videos: int = 3


def read_experiment(
    name: str | Path, overrides: Sequence[str] = (), seeds: Sequence[int] | None = None
) -> ExperimentFile:
    """Read and check an experiment file. Its recipes are not checked yet.

    Args:
        name: a path, or the name of an experiment that comes with acwm, such as
            ``ablations/conditioning``.
        overrides: further overrides for every recipe; for every plan if the file has no recipes.
        seeds: training seeds instead of those in the file; episodes of plans if it has no recipes.

    Raises:
        RecipeError: the file is missing or not an experiment, or it has an unknown entry or a value
            of the wrong type.
    """
    path = find_recipe(str(name), Path())
    content = read_recipe(path)
    if not recipes_are_trusted():
        refuse_code(content, origin=path)
    if "rows" not in content and "plans" not in content:
        raise RecipeError(
            f"{name} is not an experiment: it has no `rows` and no `plans` (docs/experiments.md)"
        )
    sections = _Sections(**_check_types(content, _Sections, ""))
    cells, everywhere = tuple(_cells(sections.rows)), (*sections.overrides, *overrides)
    tasks = tuple(_tasks(sections.plans, *(((), None) if cells else (everywhere, seeds))))
    if not cells and not tasks:
        raise RecipeError("rows: the experiment has no runs; give a row with a recipe")
    chosen = checked_seeds(sections.seeds if seeds is None or not cells else seeds)
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
    return ExperimentFile(path, experiment, everywhere, data, tasks)


def checked_seeds(seeds: Sequence[int], where: str = "seeds") -> tuple[int, ...]:
    """Check seeds of trainings or episodes.

    Raises:
        RecipeError: there are none, one is given twice, or one is negative.
    """
    if not seeds or min(seeds) < 0 or len({*seeds}) < len(seeds):
        raise RecipeError(f"{where}: give at least one, none twice and none negative")
    return tuple(seeds)


def slug(text: str) -> str:
    """Turn text into a file name without characters that are special in a shell."""
    return re.sub(r"[^\w.+=,-]+", "_", text).strip("_")


def _check_types(values: Mapping[str, Any], owner: Any, prefix: str) -> dict[str, Any]:
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
                where = f"rows.{row}.{column}".rstrip(".")
                recipe, *overrides = _words(where, cell, ("recipe",))
                yield ExperimentCell(row, column, recipe, tuple(overrides))


def _tasks(
    tables: Mapping[str, Any], overrides: Sequence[str], seeds: Sequence[int] | None
) -> Iterator[TaskChoice]:
    for title, content in tables.items():
        if content is None:  # null removes a table of the file that is extended
            continue
        here = f"plans.{title}"
        if not content.get("tasks"):
            raise RecipeError(f"{here} has no `tasks`: give a row with a model and a task")
        table = _Tasks(**_check_types(content, _Tasks, f"{here}."))
        chosen = _episodes(f"{here}.seeds", table.seeds if seeds is None else seeds)
        for row, cell in table.tasks.items():
            if cell is not None:
                model, task, *own = _words(f"{here}.tasks.{row}", cell, ("model", "task"))
                words = (*table.overrides, *own, *overrides)
                rows = tuple(table.rows)
                yield TaskChoice(title, row, model, task, words, chosen, rows, table.videos)


def _episodes(where: str, given: str | Sequence[int]) -> tuple[int, ...]:
    try:
        return checked_seeds(seed_numbers(given) if isinstance(given, str) else given, where)
    except click.BadParameter:
        raise RecipeError(f"{where}={given}: give numbers such as 0,1,2 or 0..49") from None


def _words(where: str, cell: Any, needed: Sequence[str]) -> list[str]:
    """The words of a cell, which begin with those that are `needed`."""
    try:
        words = shlex.split(cell) if isinstance(cell, str) else checked(where, cell, list[str])
    except ValueError as error:
        raise RecipeError(f"{where}={cell}: {error}".lower()) from None
    if len(words) < len(needed):
        raise RecipeError(f"{where} names no {needed[len(words)]}")
    return words


def _data(key: str, values: Mapping[str, Any]) -> DataChoice:
    side = values.get("size")
    if isinstance(side, int):
        values = {**values, "size": [side, side]}
    choice = DataChoice(**_check_types(values, DataChoice, f"data.{key}."))
    if choice.size and min(choice.size) < 1:
        raise RecipeError(f"data.{key}.size must be positive")
    train, *tests = choice.episodes or (1, 1)
    if train < 1 or min(tests) < 0 or not any(tests):
        raise RecipeError(
            f"data.{key}.episodes: give those of {', '.join(SPLITS)}; there must be some to train "
            "and to test on"
        )
    return choice
