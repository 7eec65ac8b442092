"""The plan of datasets, runs and tasks that an experiment needs, with checked recipes."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path

from acwm_core.data.card import CARD
from acwm_core.errors import RecipeError
from acwm_core.recipe import Recipe, compose
from acwm_core.recipe.compose import find_recipe, recipe_files
from acwm_experiment.files import DataChoice, ExperimentFile, slug
from acwm_experiment.logs import StepLogs
from acwm_experiment.names import run_names
from acwm_experiment.runs import DatasetSpec, RunSpec
from acwm_experiment.table import Experiment, ExperimentCell
from acwm_experiment.tasks import PlanCommand, plan_commands


@dataclass(frozen=True)
class ExperimentPlan:
    """An experiment whose recipes are all checked."""

    folder: Path  # folder of the experiment
    experiment: Experiment  # the table, with the run folders of its cells
    # each run once, ordered by seed, so that the table of the first seed is complete first
    runs: tuple[RunSpec, ...]
    tasks: tuple[PlanCommand, ...] = ()  # the tasks to solve by planning, table by table

    @property
    def report(self) -> Path:
        """The path of the report of all runs."""
        return self.folder / "report.html"

    @property
    def logs(self) -> StepLogs:
        """The logs and states of the steps."""
        return StepLogs(self.folder / "logs")


def make_plan(file: ExperimentFile, folder: Path, runs: Path | None = None) -> ExperimentPlan:
    """Compose the recipe of every cell and find the datasets and runs that it needs.

    Args:
        file: the experiment file.
        folder: folder of the experiment.
        runs: where the run folders go; ``runs`` in `folder` by default.

    Raises:
        RecipeError: a cell's recipe or a plan is wrong, a dataset is missing and cannot be
            simulated, or two different runs or plans would have the same name.
    """
    parent, experiment = runs or folder / "runs", file.experiment
    composed = [_composed(file, cell) for cell in experiment.cells]
    names = run_names(file.overrides, experiment.cells)
    cells = tuple(
        replace(
            cell,
            overrides=(*file.overrides, *cell.overrides),
            runs=tuple(_folder(parent, file, cell, name, seed) for seed in experiment.seeds),
        )
        for cell, name in zip(experiment.cells, names, strict=True)
    )
    found: dict[Path, RunSpec] = {}
    for place, seed in enumerate(experiment.seeds):
        for cell, (argument, recipe) in zip(cells, composed, strict=True):
            headings = [name for name, rows in experiment.groups.items() if cell.row in rows]
            run = RunSpec(
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
    experiment = replace(experiment, cells=cells)
    tasks = plan_commands(file.tasks, experiment, found, folder)
    experiment = replace(experiment, plans=tuple(each.job for each in tasks))
    return ExperimentPlan(folder, experiment, tuple(found.values()), tasks)


def _composed(file: ExperimentFile, cell: ExperimentCell) -> tuple[str, Recipe]:
    try:
        path = find_recipe(cell.recipe, file.path.parent)
        recipe = compose(path, [*file.overrides, *cell.overrides])
    except RecipeError as error:
        raise RecipeError(f"{cell.title}: {error}") from error
    if recipe.trainer.get("max_steps", -1) < 1:
        raise RecipeError(f"{cell.title}: set trainer.max_steps, the length of its training")
    names = {path.resolve(): name for name, path in recipe_files().items()}
    return names.get(path, str(path)), recipe


def _dataset(file: ExperimentFile, cell: ExperimentCell, recipe: Recipe) -> DatasetSpec | None:
    path, env = recipe.data["path"], recipe.env
    if ":" in path:  # a URL
        return None
    if env and file.simulates:
        choice = file.data.get(env.name) or file.data.get("default") or DataChoice()
        return DatasetSpec(Path(path), env.name, choice)
    if not (Path(path) / CARD).is_file():
        if env:
            make = shlex.join(["acwm", "generate", env.name, "--out", path])
            raise RecipeError(f"there is no dataset in {path}: make it with `{make}`")
        raise RecipeError(
            f"{cell.title}: there is no dataset in {path}, and its recipe names no environment to "
            "simulate; set data.path or env"
        )
    return None


def _folder(parent: Path, file: ExperimentFile, cell: ExperimentCell, name: str, seed: int) -> Path:
    """The run folder of a cell; an older one keeps its name."""
    before = parent / f"{_former_name(file, cell)}-{seed}"
    return before if before.is_dir() else parent / f"{name}-{seed}"


def _former_name(file: ExperimentFile, cell: ExperimentCell) -> str:
    overrides = [*file.overrides, *cell.overrides]
    overlays = "".join(dict.fromkeys(each for each in overrides if each.startswith("+")))
    others = [override for override in cell.overrides if not override.startswith("+")]
    return slug(",".join([Path(cell.recipe).stem + overlays, *others]))
