"""Tasks of an experiment that are solved by planning, as calls of `acwm plan`."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from acwm_core.data.card import CARD, DatasetCard
from acwm_core.errors import AcwmError, RecipeError, suggest
from acwm_core.plugins import catalog
from acwm_core.training.run_folder import copy_of, find_run, trained_models
from acwm_experiment.files import TaskChoice, slug
from acwm_experiment.names import safe
from acwm_experiment.runs import RunSpec
from acwm_experiment.table import Experiment
from acwm_planning.jobs import PlanningJob
from acwm_planning.results import PLANS
from acwm_planning.settings import settings_of


@dataclass(frozen=True)
class PlanCommand:
    """One call of `acwm plan`."""

    name: str  # a name that no other has, fit for a file
    job: PlanningJob  # what it makes
    arguments: tuple[str, ...]  # the words after `acwm plan`
    run: RunSpec | None  # the training that it waits for; None for a run that exists


@dataclass(frozen=True)
class _Model:
    """A model of a row: a run that the experiment trains, or one that exists."""

    name: str  # as `acwm plan` takes it
    weights: Path  # run folder with its weights
    results: Path  # run folder for its results
    environment: str
    label: str  # of its row
    run: RunSpec | None = None


def plan_commands(
    choices: Sequence[TaskChoice],
    experiment: Experiment,
    runs: Mapping[Path, RunSpec],
    folder: Path,
) -> tuple[PlanCommand, ...]:
    """Find the model of every row, and check its task and settings.

    Results with the settings that a task declares are where `acwm plan` leaves them, and others
    in `folder`.

    Args:
        choices: the rows.
        experiment: the experiment, with the run folders of its cells.
        runs: its runs, by folder.
        folder: folder of the experiment.

    Raises:
        RecipeError: there is no such model, task, setting or row, or two rows are the same.
    """
    commands: dict[str, PlanCommand] = {}
    for choice in choices:
        try:
            models = _models(choice, experiment, runs)
            new = [_plan_command(choice, model, folder) for model in models]
        except AcwmError as error:
            raise RecipeError(f"plans.{choice.table}.tasks.{choice.row}: {error}") from error
        for each in new:
            if (first := commands.setdefault(each.name, each)) is not each:
                raise RecipeError(
                    f"{first.job.title} and {each.job.title} would both be {each.name}: "
                    "give them different settings, or leave one out"
                )
    return tuple(commands.values())


def _models(
    choice: TaskChoice, experiment: Experiment, runs: Mapping[Path, RunSpec]
) -> Iterator[_Model]:
    cells = {cell.title: cell for cell in experiment.cells}
    if choice.model not in cells:
        yield _existing_model(choice, [*cells])
        return
    for seed, folder in zip(experiment.seeds, cells[choice.model].runs, strict=True):
        run, several = runs[folder], len(experiment.seeds) > 1
        label = f"{choice.row} · seed {seed}" if several else choice.row
        env = run.recipe.env.name if run.recipe.env else _environment(Path(run.recipe.data["path"]))
        yield _Model(str(folder), folder, folder, env, label, run)


def _existing_model(choice: TaskChoice, cells: Sequence[str]) -> _Model:
    source = find_run(choice.model)
    if not (source / "recipe.yaml").is_file():
        near = suggest(choice.model, [*cells, *trained_models()])
        raise RecipeError(
            f"there is no run folder, trained model or cell of this experiment {choice.model!r}"
            f"{near}"
        )
    given = source == Path(choice.model)
    folder = (source if given else copy_of(choice.model)).absolute()
    name = str(folder) if given else choice.model  # a whole path is never read as an option
    return _Model(name, source.absolute(), folder, _environment(source), choice.row)


def _environment(folder: Path) -> str:
    """The environment of a dataset or run folder."""
    return DatasetCard.read(folder / CARD).environment.name


def _plan_command(choice: TaskChoice, model: _Model, folder: Path) -> PlanCommand:
    task = catalog().component("environment", model.environment).load_task(choice.task)
    settings = settings_of(choice.overrides, declared=task.planning)
    rows = settings.rows(choice.rows)
    if not rows:
        raise RecipeError(f"rows={[*choice.rows]}: give one that can be played, such as model")
    words = [f"{Path(model.name).name}-{choice.task}", *choice.overrides]
    name, former = safe("-".join(words)), slug(",".join(words))
    usual, own = model.results / PLANS / choice.task, folder / PLANS
    own /= former if (own / former).is_dir() else name
    job = PlanningJob(
        table=choice.table,
        row=model.label,
        run=model.weights,
        environment=model.environment,
        task=choice.task,
        settings=json.loads(json.dumps(settings.to_dict())),  # as it is read again
        rows=tuple(rows),
        seeds=choice.seeds,
        folder=own if choice.overrides else usual,
    )
    typed = [model.name, choice.task, *choice.overrides, "--seeds", _numbers(choice.seeds)]
    typed += [word for row in rows for word in ("--row", row)]
    typed += ["--videos", str(choice.videos), "--out", str(job.folder)]
    return PlanCommand(name, job, tuple(typed), model.run)


def _numbers(seeds: Sequence[int]) -> str:
    """Seeds as `acwm plan` takes them."""
    span = range(seeds[0], seeds[-1] + 1)
    return f"{span[0]}..{span[-1]}" if [*seeds] == [*span] else ",".join(map(str, seeds))
