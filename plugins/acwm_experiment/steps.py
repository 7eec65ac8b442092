"""The steps of an experiment: `acwm` commands, and their progress as seen from their results."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from acwm_core.data.card import CARD, DatasetCard
from acwm_core.env.episode import SPLITS
from acwm_core.errors import DataError, TrainingError
from acwm_core.evaluation.config import EvaluationConfig, setting_overrides
from acwm_core.files import parse_json
from acwm_core.plugins import catalog
from acwm_core.recipe import Recipe, recipe_differences
from acwm_core.recipe.compose import read_recipe, recipe_folder
from acwm_core.training.run_folder import RunFolder
from acwm_executors.batch import Job
from acwm_experiment.files import slug
from acwm_experiment.plan import ExperimentPlan
from acwm_experiment.runs import DatasetSpec, RunSpec
from acwm_experiment.table import EXPERIMENT_FILE, RUN_SUMMARY
from acwm_experiment.tasks import PlanCommand
from acwm_planning.results import PLAN_SUMMARY

_recipe = functools.cache(Recipe.from_yaml)  # the recipe of a run never changes


@dataclass(frozen=True)
class ExperimentStep(Job):
    """One command, run here or as a job of a batch system."""

    title: str = ""  # readable description of what it does
    dataset: DatasetSpec | None = None  # for ``simulate`` steps
    run: RunSpec | None = None  # for ``train`` and ``evaluate`` steps
    task: PlanCommand | None = None  # for ``plan`` steps

    @property
    def size(self) -> tuple[int, str]:
        """How much work it is, with the unit: steps of a training, or episodes of a plan."""
        if self.task:
            return self.task.job.episodes, "episodes"
        return (self.run.max_steps, "steps") if self.run else (0, "")


def all_steps(plan: ExperimentPlan, workers: int | None = None) -> list[ExperimentStep]:
    """All steps, each after those it needs; simulations use `workers` processes or all cores."""
    steps: dict[str, ExperimentStep] = {}
    for run in plan.runs:
        needs: tuple[str, ...] = ()
        if run.dataset:
            simulation = _simulation(run.dataset, workers)
            steps.setdefault(simulation.name, simulation)
            needs = (simulation.name,)
        train, evaluate = f"train-{run.folder.name}", f"evaluate-{run.folder.name}"
        fit = ("fit", *run.arguments, "--out", str(run.folder), "resume=auto")
        score = ("evaluate", str(run.folder), *evaluation_overrides(run), "--overwrite")
        nodes, gpus = run.recipe.trainer.get("num_nodes", 1), run.gpus
        first, then = f"train {run.title}", f"evaluate {run.title}"
        before = (*needs, train)
        steps[train] = ExperimentStep(
            train, "train", fit, needs, nodes, max(1, gpus), gpus, first, run=run
        )
        steps[evaluate] = ExperimentStep(
            evaluate, "evaluate", score, before, 1, 1, min(1, gpus), then, run=run
        )
    for task in plan.tasks:
        steps[f"plan-{task.name}"] = _planning(task)
    if "report" not in catalog().registry("command"):  # no plugin provides it
        return [*steps.values()]
    results = tuple(step.name for step in steps.values() if step.kind in ("evaluate", "plan"))
    command = ("report", str(plan.folder), "--out", str(plan.report))
    report = ExperimentStep("report", "report", command, results, title="write the report")
    return [*steps.values(), report]


def _planning(task: PlanCommand) -> ExperimentStep:
    needs, gpus = ((f"train-{task.run.folder.name}",), task.run.gpus) if task.run else ((), 0)
    return ExperimentStep(
        f"plan-{task.name}",
        "plan",
        ("plan", *task.arguments),
        needs,
        gpus=min(1, gpus),
        title=f"plan {task.job.title}",
        task=task,
    )


def _simulation(dataset: DatasetSpec, workers: int | None) -> ExperimentStep:
    choice = dataset.choice
    options = {
        "--episodes": ",".join(map(str, choice.episodes or ())),
        "--size": "x".join(map(str, choice.size or ())),
        "--seed": str(choice.seed or ""),
        "--exploration": str(choice.exploration or ""),
        "--shift": str(choice.shift or ""),
        "--workers": "" if workers is None else str(workers),
    }
    given = [word for option, value in options.items() if value for word in (option, value)]
    return ExperimentStep(
        f"simulate-{slug(str(dataset.path))}",
        "simulate",
        ("generate", dataset.environment, "--out", str(dataset.path), *given),
        title=f"simulate {dataset.environment} into {dataset.path}",
        dataset=dataset,
    )


def step_progress(step: ExperimentStep, plan: ExperimentPlan) -> float:
    """The share of a step's work that is done, in [0, 1].

    See `training_progress` and `PlanningJob.progress`.
    """
    if step.dataset:
        return float(dataset_is_whole(step.dataset))
    if step.run:
        training = training_progress(step.run)
        return training if step.kind == "train" else float(training == 1 and is_evaluated(step.run))
    if step.task:
        run = step.task.run
        ready = run is None or training_progress(run) == 1  # else it will have other weights
        return step.task.job.progress() if ready else 0.0
    shown = [plan.folder / EXPERIMENT_FILE, *(run.folder / RUN_SUMMARY for run in plan.runs)]
    shown += [task.job.folder / PLAN_SUMMARY for task in plan.tasks]
    newest = max((path.stat().st_mtime_ns for path in shown if path.exists()), default=0)
    return float(plan.report.exists() and plan.report.stat().st_mtime_ns >= newest)


def all_progress(steps: Sequence[ExperimentStep], plan: ExperimentPlan) -> dict[str, float]:
    """`step_progress` of every step, by name; datasets no longer needed count as done."""
    progress = {step.name: step_progress(step, plan) for step in steps}
    needed = {name for step in steps if progress[step.name] < 1 for name in step.needs}
    for step in steps:
        if step.kind == "simulate" and step.name not in needed:
            progress[step.name] = 1.0  # may have been removed after use
        if step.kind == "report" and any(progress[name] < 1 for name in step.needs):
            progress[step.name] = 0.0  # there will be more to show
    return progress


def dataset_is_whole(dataset: DatasetSpec) -> bool:
    """Whether the requested dataset exists; `acwm generate` refuses a folder with another one."""
    if not (dataset.path / CARD).is_file():
        return False
    card, choice = DatasetCard.read(dataset.path), dataset.choice
    environment = card.environment
    if environment.name != dataset.environment or choice.size not in (None, environment.frame_size):
        return False
    if card.source:  # a recorded dataset has no requested size
        return all(split in card.checksums for split in card.splits)
    usual = tuple(environment.episodes.get(split, 0) for split in SPLITS)
    pairs = zip(SPLITS, choice.episodes or usual, strict=True)
    whole = all(card.splits.get(s) == n and s in card.checksums for s, n in pairs if n)
    origin = (card.seed, card.exploration, card.shift, dict(card.factors))
    return whole and origin == (choice.seed, choice.exploration, choice.shift, {})


def training_progress(run: RunSpec) -> float:
    """The share of its steps that a training has done, in [0, 1].

    Raises:
        TrainingError: the run folder holds another run.
    """
    if not RunFolder(run.folder).recipe.is_file():
        return 0.0
    differences = recipe_differences(_recipe(RunFolder(run.folder).recipe), run.recipe)
    steps = saved_steps(run.folder)
    if steps > run.max_steps:
        differences.append(f"trainer.max_steps was {steps}, is {run.max_steps}")
    if differences:
        raise TrainingError(
            f"{run.folder} holds another run than the experiment needs: "
            f"{'; '.join(differences)}; choose another --out, or delete it"
        )
    return steps / run.max_steps


def saved_steps(run: Path) -> int:
    """The optimiser steps of the weights in a run folder; 0 if there are no readable weights."""
    import safetensors

    safe_open = cast(Any, safetensors).safe_open
    try:
        with safe_open(RunFolder(run).weights, framework="np") as file:
            metadata: dict[str, str] = file.metadata() or {}
        return int(parse_json(metadata["acwm"])["step"])
    except (OSError, safetensors.SafetensorError, LookupError, TypeError, ValueError):
        return 0


def is_evaluated(run: RunSpec) -> bool:
    """Whether the weights of a finished run were evaluated with its current recipe."""
    summary, weights = run.folder / RUN_SUMMARY, RunFolder(run.folder).weights
    try:
        provenance: Mapping[str, Any] = parse_json(summary.read_bytes())["provenance"]
        newer = summary.stat().st_mtime_ns >= weights.stat().st_mtime_ns
        settings = {**EvaluationConfig().to_dict(), **provenance["evaluation"]}  # some may be new
        same = settings == EvaluationConfig(**run.recipe.evaluation).to_dict()
        return newer and same and provenance["training_steps"] == run.max_steps
    except (OSError, ValueError, LookupError, TypeError, DataError):
        return False


def evaluation_overrides(run: RunSpec) -> list[str]:
    """Overrides for `acwm evaluate`, so that a run trained earlier is evaluated as asked for now.

    Its own recipe may say something else, for example the defaults when it was trained.
    """
    evaluation = EvaluationConfig(**run.recipe.evaluation).to_dict()
    defaults = read_recipe(recipe_folder() / "base.yaml")["evaluation"]
    overrides = setting_overrides({**EvaluationConfig().to_dict(), **defaults}, evaluation)
    if RunFolder(run.folder).recipe.is_file():
        overrides += setting_overrides(_recipe(RunFolder(run.folder).recipe).evaluation, evaluation)
    return list(dict.fromkeys(overrides))
