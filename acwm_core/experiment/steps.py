"""The steps of an experiment: commands of `acwm`, what each needs, and how far it is.

How far a step is, is told by the results themselves, whoever made them.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast, get_args

from acwm_core.data.card import CARD, DatasetCard
from acwm_core.episode import SPLITS, Split
from acwm_core.errors import DataError, TrainingError
from acwm_core.evaluation.config import EvaluationConfig, setting_overrides
from acwm_core.executors import Job, JobKind
from acwm_core.experiment.folder import FILE, SUMMARY
from acwm_core.experiment.plan import Plan, PlannedDataset, PlannedRun, slug
from acwm_core.recipe import Recipe, recipe_differences
from acwm_core.recipe.compose import read_recipe, recipe_folder

STEP_KINDS: tuple[JobKind, ...] = get_args(JobKind)

WEIGHTS, RECIPE = "model.safetensors", "recipe.yaml"
"""Files of a run folder (`acwm_core.training.run.RunFolder` needs torch)."""

Progress = float
"""The share of a step's work that is done, in [0, 1]; at 1 nothing is left."""


@dataclass(frozen=True)
class Step(Job):
    """One command, which may be a job of a batch system.

    Attributes:
        title: what it does, for people.
        dataset: of ``simulate``.
        run: of ``train`` and ``evaluate``.
    """

    title: str = ""
    dataset: PlannedDataset | None = None
    run: PlannedRun | None = None


def all_steps(plan: Plan, workers: int | None = None) -> list[Step]:
    """Every step of an experiment, each after those that it needs.

    Args:
        plan: the experiment.
        workers: processes that a simulation takes; one per core by default.
    """
    steps: dict[str, Step] = {}
    evaluations: list[str] = []
    for run in plan.runs:
        needs: tuple[str, ...] = ()
        if run.dataset:
            simulation = _simulation(run.dataset, workers)
            steps.setdefault(simulation.name, simulation)
            needs = (simulation.name,)
        training, evaluation = _training(run, needs), _evaluation(run, needs)
        steps |= {training.name: training, evaluation.name: evaluation}
        evaluations.append(evaluation.name)
    report = ("report", str(plan.folder), "--out", str(plan.report))
    last = Step("report", "report", report, tuple(evaluations), title="write the report")
    return [*steps.values(), last]


def _simulation(dataset: PlannedDataset, workers: int | None) -> Step:
    choice = dataset.choice
    options = ["--out", str(dataset.path)]
    if choice.episodes:
        options += ["--episodes", ",".join(map(str, choice.episodes))]
    if choice.size:
        options += ["--size", "x".join(map(str, choice.size))]
    if choice.seed:
        options += ["--seed", str(choice.seed)]
    if workers is not None:
        options += ["--workers", str(workers)]
    name = f"simulate-{slug(str(dataset.path))}"
    title = f"simulate {dataset.environment} into {dataset.path}"
    command = ("generate", dataset.environment, *options)
    return Step(name, "simulate", command, title=title, dataset=dataset)


def _training(run: PlannedRun, needs: tuple[str, ...]) -> Step:
    return Step(
        f"train-{run.folder.name}",
        "train",
        ("fit", *run.arguments, "--out", str(run.folder), "resume=auto"),
        needs,
        nodes=run.nodes,
        tasks=max(1, run.gpus),
        gpus=run.gpus,
        title=f"train {run.title}",
        run=run,
    )


def _evaluation(run: PlannedRun, needs: tuple[str, ...]) -> Step:
    return Step(
        f"evaluate-{run.folder.name}",
        "evaluate",
        ("evaluate", str(run.folder), *evaluation_overrides(run)),
        (*needs, f"train-{run.folder.name}"),
        gpus=min(1, run.gpus),
        title=f"evaluate {run.title}",
        run=run,
    )


def step_progress(step: Step, plan: Plan) -> Progress:
    """How far a step is.

    Raises:
        DataError: a folder holds another dataset.
        TrainingError: a folder holds another run.
    """
    if step.dataset:
        return float(dataset_is_whole(step.dataset))
    if step.run:
        training = training_progress(step.run)
        if step.kind == "train":
            return training
        return float(training == 1 and is_evaluated(step.run))
    shown = [plan.folder / FILE, *(run.folder / SUMMARY for run in plan.runs)]
    newest = max((path.stat().st_mtime_ns for path in shown if path.exists()), default=0)
    return float(plan.report.exists() and plan.report.stat().st_mtime_ns >= newest)


def all_progress(steps: Sequence[Step], plan: Plan) -> dict[str, Progress]:
    """How far every step is, by name; what nothing needs any more counts as done.

    Raises:
        DataError: a folder holds another dataset.
        TrainingError: a folder holds another run.
    """
    progress = {step.name: step_progress(step, plan) for step in steps}
    needed = {name for step in steps if progress[step.name] < 1 for name in step.needs}
    for step in steps:
        if step.kind == "simulate" and step.name not in needed:
            progress[step.name] = 1.0  # removed after it was used
        if step.kind == "report" and any(progress[name] < 1 for name in step.needs):
            progress[step.name] = 0.0  # there will be more to show
    return progress


def dataset_is_whole(dataset: PlannedDataset) -> bool:
    """Whether a dataset is there.

    Raises:
        DataError: its folder holds another one, or none that can be read.
    """
    if not (dataset.path / CARD).is_file():
        return False
    card = DatasetCard.read(dataset.path)
    differences = list(_differences(dataset, card))
    if differences:
        raise DataError(
            f"{dataset.path} holds another dataset than the experiment asks for: "
            f"{'; '.join(differences)}; set data.path to another folder, or delete it"
        )
    return all(split in card.checksums for split in _counts(dataset, card) or card.splits)


def _differences(dataset: PlannedDataset, card: DatasetCard) -> Iterator[str]:
    choice, there = dataset.choice, card.environment
    if there.name != dataset.environment:
        yield f"it is of {there.name}, not {dataset.environment}"
    if choice.size and choice.size != there.frame_size:
        (height, width), (wanted_height, wanted_width) = there.frame_size, choice.size
        yield f"frames are {height}×{width}, not {wanted_height}×{wanted_width}"
    if card.source:
        return
    if card.seed != choice.seed:
        yield f"its seed is {card.seed}, not {choice.seed}"
    if card.factors:
        yield f"factors are overridden ({', '.join(card.factors)})"
    for split, count in _counts(dataset, card).items():
        made = card.splits.get(split)
        if made not in (None, count):
            yield f"{split} has {made} episodes, not {count}"


def _counts(dataset: PlannedDataset, card: DatasetCard) -> dict[Split, int]:
    """The episodes per split that there should be; empty if that is open."""
    if card.source:  # recorded: what there is
        return {}
    usual = tuple(card.environment.episodes.get(split, 0) for split in SPLITS)
    pairs = zip(SPLITS, dataset.choice.episodes or usual, strict=True)
    return {split: count for split, count in pairs if count}


def training_progress(run: PlannedRun) -> Progress:
    """How far a training is.

    Raises:
        TrainingError: the run folder holds another run.
    """
    if not (run.folder / RECIPE).is_file():
        return 0.0
    differences = recipe_differences(_recipe(run.folder / RECIPE), run.recipe)
    steps = saved_steps(run.folder)
    if steps > run.max_steps:
        differences.append(f"trainer.max_steps was {steps}, is {run.max_steps}")
    if differences:
        raise TrainingError(
            f"{run.folder} holds another run than the experiment asks for: "
            f"{'; '.join(differences)}; choose another --out, or delete it"
        )
    return steps / run.max_steps


@functools.cache
def _recipe(file: Path) -> Recipe:
    """A run's recipe, which stays what it is."""
    return Recipe.from_yaml(file)


def saved_steps(run: Path) -> int:
    """Optimiser steps behind the weights of a run folder; 0 without any that can be read."""
    import safetensors

    opened = cast(Any, safetensors).safe_open
    try:
        with opened(run / WEIGHTS, framework="np") as file:
            metadata: dict[str, str] = file.metadata() or {}
        return int(json.loads(metadata["acwm"])["step"])
    except (OSError, safetensors.SafetensorError, KeyError, ValueError):
        return 0


def is_evaluated(run: PlannedRun) -> bool:
    """Whether the weights of a finished run were evaluated as its recipe says now."""
    summary, weights = run.folder / SUMMARY, run.folder / WEIGHTS
    try:
        found: Mapping[str, Any] = json.loads(summary.read_text(encoding="utf-8"))["provenance"]
        newer = summary.stat().st_mtime_ns >= weights.stat().st_mtime_ns
        settings = {**EvaluationConfig().to_dict(), **found["evaluation"]}  # some may be new
        same = settings == EvaluationConfig(**run.recipe.evaluation).to_dict()
        return newer and same and found["training_steps"] == run.max_steps
    except (OSError, ValueError, KeyError, TypeError):
        return False


def evaluation_overrides(run: PlannedRun) -> list[str]:
    """What `acwm evaluate` is told, so that a run trained before is evaluated as asked for now.

    Its own recipe may say something else, if only what was usual when it was trained.
    """
    wanted = EvaluationConfig(**run.recipe.evaluation).to_dict()
    listed = read_recipe(recipe_folder() / "base.yaml")["evaluation"]
    overrides = setting_overrides({**EvaluationConfig().to_dict(), **listed}, wanted)
    if (run.folder / RECIPE).is_file():
        trained = _recipe(run.folder / RECIPE).evaluation
        overrides += setting_overrides(
            {name: trained[name] for name in trained if name in wanted}, wanted
        )
    return list(dict.fromkeys(overrides))
