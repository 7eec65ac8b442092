"""From an experiment file to the datasets and runs that it takes, every recipe checked."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

from acwm_core.data.card import CARD
from acwm_core.errors import RecipeError
from acwm_core.experiment.config import DataChoice, ExperimentFile
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
        accelerator, devices = (self.recipe.trainer.get(k) for k in ("accelerator", "devices"))
        return max(devices, 0) if accelerator in GPUS and isinstance(devices, int) else 0

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
        runs: each once, seed by seed, so that the first seed's table is whole first.
    """

    folder: Path
    experiment: Experiment
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
    """A cell's recipe: how it is called from any folder, and what it says."""
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
    """What has to be simulated for a cell."""
    path, env = recipe.data["path"], recipe.env
    if ":" in path:  # a URL
        return None
    if env:
        choice = file.data.get(env.name) or file.data.get("default") or DataChoice()
        return PlannedDataset(Path(path), env.name, choice)
    if not (Path(path) / CARD).is_file():
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
