"""Experiment files, and the datasets and runs that they take, every recipe checked."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast, get_type_hints

from acwm_core.data.card import CARD
from acwm_core.episode import SPLITS
from acwm_core.errors import RecipeError, suggest
from acwm_core.evaluation.experiment import Experiment, ExperimentCell
from acwm_core.recipe import Recipe, compose
from acwm_core.recipe.compose import find_recipe, read_recipe, recipe_folder
from acwm_core.recipe.types import checked
from acwm_experiment.logs import StepLogs


@dataclass(frozen=True)
class DataChoice:
    """How a dataset is simulated if it is not there."""

    # of train, ind_test and ood_test; None for the environment's full benchmark
    episodes: tuple[int, int, int] | None = None
    # of the frames, height and width; None for the environment's own
    size: tuple[int, int] | None = None
    seed: int = 0  # of the dataset
    exploration: float = 0.0  # share of the training episodes, see `acwm generate`


@dataclass(frozen=True)
class ExperimentFile:
    """A checked experiment file."""

    path: Path  # the file
    experiment: Experiment  # its table, of which cells have their own overrides and no runs yet
    overrides: tuple[str, ...]  # for every recipe, beside the cell's own
    data: Mapping[str, DataChoice]  # how datasets are made, by environment or "default"
    simulates: bool = True  # datasets that are not there; else they are refused


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

    Raises:
        RecipeError: a missing file, no experiment, an unknown entry or a value of a wrong type.
    """
    path = find_recipe(str(name), Path())
    content = read_recipe(path)
    if "rows" not in content:
        raise RecipeError(f"{name} is not an experiment: it has no `rows` (docs/experiments.md)")
    sections = _Sections(**_typed(content, _Sections, ""))
    cells = tuple(_cells(sections.rows))
    if not cells:
        raise RecipeError("rows: there is no cell")
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
    """Seeds of trainings.

    Raises:
        RecipeError: there is none, one is given twice, or one is negative.
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
            if cell is not None:  # left out of a table that the file extends
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


@dataclass(frozen=True)
class PlannedDataset:
    """A dataset to train and test on."""

    path: Path  # its folder
    environment: str  # what is simulated
    choice: DataChoice  # how, if it is not there


@dataclass(frozen=True)
class PlannedRun:
    """One training and its evaluation."""

    folder: Path  # the run folder
    title: str  # the cell and seed, for people
    arguments: tuple[str, ...]  # recipe and overrides of `acwm fit`
    recipe: Recipe  # the same composed
    # what has to be there first; None for data of one's own, or behind a URL
    dataset: PlannedDataset | None

    @property
    def max_steps(self) -> int:
        """Optimiser steps of the training."""
        return self.recipe.trainer["max_steps"]

    @property
    def gpus(self) -> int:
        """GPUs per node that the recipe asks for by number; 0 if it does not."""
        accelerator, devices = (self.recipe.trainer.get(k) for k in ("accelerator", "devices"))
        return max(devices, 0) if accelerator in ("gpu", "cuda") and isinstance(devices, int) else 0


@dataclass(frozen=True)
class Plan:
    """An experiment, all recipes checked."""

    folder: Path  # where it goes
    experiment: Experiment  # the table, with the run folders of its cells
    # each once, seed by seed, so that the first seed's table is whole first
    runs: tuple[PlannedRun, ...]

    @property
    def report(self) -> Path:
        """The report of all runs."""
        return self.folder / "report.html"

    @property
    def logs(self) -> StepLogs:
        """What every step printed, and what became of it."""
        return StepLogs(self.folder / "logs")


def make_plan(file: ExperimentFile, folder: Path, runs: Path | None = None) -> Plan:
    """Compose every cell's recipe and find what it takes.

    Args:
        runs: where the run folders go, ``runs`` in `folder` by default.

    Raises:
        RecipeError: a cell's recipe is wrong, or two cells cannot be told apart.
    """
    parent, experiment = runs or folder / "runs", file.experiment
    composed = [_composed(file, cell) for cell in experiment.cells]
    cells = tuple(
        replace(
            cell,
            overrides=(*file.overrides, *cell.overrides),
            runs=tuple(parent / f"{_name(file, cell)}-{seed}" for seed in experiment.seeds),
        )
        for cell in experiment.cells
    )
    found: dict[Path, PlannedRun] = {}
    for place, seed in enumerate(experiment.seeds):
        for cell, (argument, recipe) in zip(cells, composed, strict=True):
            headings = [name for name, rows in experiment.groups.items() if cell.row in rows]
            run = PlannedRun(
                folder=cell.runs[place],
                title=f"{' · '.join([*headings, cell.title])} · seed {seed}",
                arguments=(argument, *cell.overrides, f"training.seed={seed}"),
                recipe=replace(recipe, training={**recipe.training, "seed": seed}),
                dataset=_dataset(file, cell, recipe),
            )
            first = found.setdefault(run.folder, run)
            if first.recipe != run.recipe:
                raise RecipeError(
                    f"{first.title} and {run.title} would both be {run.folder.name}, but their "
                    "recipes differ: give them different names"
                )
    return Plan(folder, replace(experiment, cells=cells), tuple(found.values()))


def _composed(file: ExperimentFile, cell: ExperimentCell) -> tuple[str, Recipe]:
    try:
        path = find_recipe(cell.recipe, file.path.parent)
        recipe = compose(path, [*file.overrides, *cell.overrides])
    except RecipeError as error:
        raise RecipeError(f"{cell.title}: {error}") from error
    if recipe.trainer.get("max_steps", -1) < 1:
        raise RecipeError(f"{cell.title}: set trainer.max_steps, the length of its training")
    shipped = recipe_folder().resolve()
    if path.is_relative_to(shipped):
        return str(path.relative_to(shipped).with_suffix("")), recipe
    return str(path), recipe


def _dataset(file: ExperimentFile, cell: ExperimentCell, recipe: Recipe) -> PlannedDataset | None:
    path, env = recipe.data["path"], recipe.env
    if ":" in path:  # a URL
        return None
    if env and file.simulates:
        choice = file.data.get(env.name) or file.data.get("default") or DataChoice()
        return PlannedDataset(Path(path), env.name, choice)
    if not (Path(path) / CARD).is_file():
        if env:
            make = f"acwm generate {env.name} --out {path}"
            raise RecipeError(f"there is no dataset in {path}: make it with `{make}`")
        raise RecipeError(
            f"{cell.title}: there is no dataset in {path}, and its recipe names no environment to "
            "simulate; set data.path or env"
        )
    return None


def _name(file: ExperimentFile, cell: ExperimentCell) -> str:
    """``push_cube+small``; overrides of the cell that are no overlay are in it, too."""
    overrides = [*file.overrides, *cell.overrides]
    overlays = "".join(dict.fromkeys(each for each in overrides if each.startswith("+")))
    others = [override for override in cell.overrides if not override.startswith("+")]
    return slug(",".join([Path(cell.recipe).stem + overlays, *others]))


def slug(text: str) -> str:
    """The text as a file name that no shell minds."""
    return re.sub(r"[^\w.+=,-]+", "_", text).strip("_")
