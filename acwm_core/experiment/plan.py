"""From an experiment file to the datasets and runs that it takes, every recipe checked."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from acwm_core.data.card import CARD
from acwm_core.errors import RecipeError
from acwm_core.experiment.config import DEFAULT, DataChoice, ExperimentFile
from acwm_core.experiment.folder import Experiment, ExperimentCell, StepLogs
from acwm_core.recipe import Recipe, compose
from acwm_core.recipe.compose import find_recipe, recipe_folder

GPUS = ("gpu", "cuda")
"""Lightning's accelerators of which a scheduler must be asked for a number."""


@dataclass(frozen=True)
class PlannedDataset:
    """A dataset to train and test on.

    Attributes:
        path: its folder.
        environment: what is simulated.
        choice: how, if it is not there.
    """

    path: Path
    environment: str
    choice: DataChoice


@dataclass(frozen=True)
class PlannedRun:
    """One training and its evaluation.

    Attributes:
        folder: the run folder.
        title: the cell and seed, for people.
        arguments: recipe and overrides of `acwm fit`.
        recipe: the same composed.
        dataset: what has to be there first; None for data of one's own, or behind a URL.
    """

    folder: Path
    title: str
    arguments: tuple[str, ...]
    recipe: Recipe
    dataset: PlannedDataset | None

    @property
    def max_steps(self) -> int:
        """Optimiser steps of the training."""
        return self.recipe.trainer["max_steps"]

    @property
    def gpus(self) -> int:
        """GPUs per node that the recipe asks for by number; 0 if it does not."""
        devices = self.recipe.trainer.get("devices")
        asks = self.recipe.trainer.get("accelerator") in GPUS and isinstance(devices, int)
        return max(devices, 0) if asks and isinstance(devices, int) else 0

    @property
    def nodes(self) -> int:
        """Machines that the training takes."""
        return self.recipe.trainer.get("num_nodes", 1)


@dataclass(frozen=True)
class Plan:
    """An experiment, all recipes checked.

    Attributes:
        folder: where it goes.
        experiment: the table, with the run folders of its cells.
        datasets: each once, in the order of the cells.
        runs: each once, seed by seed, so that the first seed's table is whole first.
    """

    folder: Path
    experiment: Experiment
    datasets: tuple[PlannedDataset, ...]
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
        file: the experiment.
        folder: where it goes.
        runs: where the run folders go, ``runs`` in `folder` by default.

    Raises:
        RecipeError: a cell's recipe is wrong, or two cells cannot be told apart.
    """
    parent, experiment = runs or folder / "runs", file.experiment
    recipes = [_composed(file, cell) for cell in experiment.cells]
    datasets = _datasets(file, recipes)
    found: dict[Path, PlannedRun] = {}
    for seed in experiment.seeds:
        for cell, recipe in zip(experiment.cells, recipes, strict=True):
            overrides = (*file.overrides, *cell.overrides, f"training.seed={seed}")
            run = PlannedRun(
                folder=parent / _name(file, cell, seed),
                title=f"{_full_title(experiment, cell)} · seed {seed}",
                arguments=(_recipe_argument(file, cell), *overrides),
                recipe=replace(recipe, training={**recipe.training, "seed": seed}),
                dataset=datasets.get(recipe.data["path"]),
            )
            _check_name(found.setdefault(run.folder, run), run)
    cells = tuple(
        replace(
            cell,
            overrides=(*file.overrides, *cell.overrides),
            runs=tuple(parent / _name(file, cell, seed) for seed in experiment.seeds),
        )
        for cell in experiment.cells
    )
    planned = replace(experiment, cells=cells)
    return Plan(folder, planned, tuple(datasets.values()), tuple(found.values()))


def _full_title(experiment: Experiment, cell: ExperimentCell) -> str:
    headings = [heading for heading, rows in experiment.groups.items() if cell.row in rows]
    return " · ".join([*headings, cell.title])


def _composed(file: ExperimentFile, cell: ExperimentCell) -> Recipe:
    try:
        path = find_recipe(cell.recipe, file.path.parent)
        recipe = compose(path, [*file.overrides, *cell.overrides])
    except RecipeError as error:
        raise RecipeError(f"{cell.title}: {error}") from error
    if recipe.trainer.get("max_steps", -1) < 1:
        raise RecipeError(f"{cell.title}: set trainer.max_steps, the length of its training")
    return recipe


def _datasets(file: ExperimentFile, recipes: Sequence[Recipe]) -> dict[str, PlannedDataset]:
    """What has to be simulated, by ``data.path``."""
    found: dict[str, PlannedDataset] = {}
    for cell, recipe in zip(file.experiment.cells, recipes, strict=True):
        path = recipe.data["path"]
        if ":" in path:  # a URL
            continue
        if recipe.env is None:
            if not (Path(path) / CARD).is_file():
                raise RecipeError(
                    f"{cell.title}: there is no dataset in {path}, and its recipe names no "
                    "environment to simulate; set data.path or env"
                )
            continue
        environment = recipe.env.name
        choice = file.data.get(environment) or file.data.get(DEFAULT) or DataChoice()
        dataset = found.setdefault(path, PlannedDataset(Path(path), environment, choice))
        if dataset.environment != environment:
            raise RecipeError(
                f"{cell.title}: {path} cannot hold both {dataset.environment} and {environment}; "
                "set data.path"
            )
    return found


def _recipe_argument(file: ExperimentFile, cell: ExperimentCell) -> str:
    """How the recipe is called from another folder than that of the experiment file."""
    path = find_recipe(cell.recipe, file.path.parent)
    shipped = recipe_folder().resolve()
    if path.is_relative_to(shipped):
        return str(path.relative_to(shipped).with_suffix(""))
    return str(path)


def _name(file: ExperimentFile, cell: ExperimentCell, seed: int) -> str:
    """``push_cube+small-0``; overrides of the cell that are no overlay are in it, too."""
    overrides = [*file.overrides, *cell.overrides]
    overlays = "".join(dict.fromkeys(each for each in overrides if each.startswith("+")))
    others = [override for override in cell.overrides if not override.startswith("+")]
    parts = ",".join([Path(cell.recipe).stem + overlays, *others])
    return f"{slug(parts)}-{seed}"


def slug(text: str) -> str:
    """The text as a file name that no shell minds."""
    return re.sub(r"[^\w.+=,-]+", "_", text).strip("_")


def _check_name(first: PlannedRun, second: PlannedRun) -> None:
    one, other = first.recipe.to_dict(), second.recipe.to_dict()
    if one != other:
        differing = [name for name in {**one, **other} if one.get(name) != other.get(name)]
        raise RecipeError(
            f"{first.title} and {second.title} would both be {second.folder.name}, but they differ "
            f"in {', '.join(differing)}: give the recipes different names"
        )
