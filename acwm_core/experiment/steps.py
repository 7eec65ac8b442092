"""The steps of an experiment: commands of `acwm`, what each needs, and what is left to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from acwm_core.experiment.plan import Dataset, Plan, Run, slug
from acwm_core.experiment.states import (
    State,
    dataset_state,
    evaluation_overrides,
    evaluation_state,
    report_state,
    training_state,
)

Kind = Literal["simulate", "train", "evaluate", "report"]

KINDS: tuple[Kind, ...] = ("simulate", "train", "evaluate", "report")


@dataclass(frozen=True)
class Step:
    """One command.

    Attributes:
        name: of its log, without ending.
        kind: what it does.
        title: the same for people.
        command: the words after ``acwm``.
        needs: names of the steps that come before it. A report makes do with those that succeed.
        dataset: of ``simulate``.
        run: of ``train`` and ``evaluate``.
    """

    name: str
    kind: Kind
    title: str
    command: tuple[str, ...]
    needs: tuple[str, ...] = ()
    dataset: Dataset | None = None
    run: Run | None = None


def all_steps(plan: Plan, workers: int | None = None) -> list[Step]:
    """Every step of an experiment, each after those that it needs.

    Args:
        plan: the experiment.
        workers: processes that a simulation takes; one per core by default.
    """
    steps: dict[str, Step] = {}
    evaluations: list[str] = []
    for run in plan.runs:
        simulation = _simulation(run.dataset, workers) if run.dataset else None
        needs = (simulation.name,) if simulation else ()
        training, evaluation = _training(run, needs), _evaluation(run, needs)
        for step in (*((simulation,) if simulation else ()), training, evaluation):
            steps.setdefault(step.name, step)
        evaluations.append(evaluation.name)
    folder = plan.folder
    command = ("report", str(folder.path), "--out", str(folder.report))
    report = Step("report", "report", "write the report", command, tuple(evaluations))
    return [*steps.values(), report]


def _simulation(dataset: Dataset, workers: int | None) -> Step:
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
    return Step(
        name, "simulate", title, ("generate", dataset.environment, *options), dataset=dataset
    )


def _training(run: Run, needs: tuple[str, ...]) -> Step:
    command = ("fit", *run.arguments, "--out", str(run.folder), "resume=auto")
    return Step(f"train-{run.folder.name}", "train", f"train {run.title}", command, needs, run=run)


def _evaluation(run: Run, needs: tuple[str, ...]) -> Step:
    name = run.folder.name
    command = ("evaluate", str(run.folder), *evaluation_overrides(run))
    needs = (*needs, f"train-{name}")
    return Step(f"evaluate-{name}", "evaluate", f"evaluate {run.title}", command, needs, run=run)


def state_of(step: Step, plan: Plan) -> State:
    """How far a step is.

    Raises:
        DataError: a folder holds another dataset.
        TrainingError: a folder holds another run.
    """
    if step.dataset:
        return dataset_state(step.dataset)
    if step.run:
        training = training_state(step.run)
        if step.kind == "train":
            return training
        return evaluation_state(step.run) if training.done else State(False)
    return report_state(plan.folder, plan.runs)


def states_of(steps: Sequence[Step], plan: Plan) -> dict[str, State]:
    """How far every step is, by name; what nothing needs any more counts as done.

    Raises:
        DataError: a folder holds another dataset.
        TrainingError: a folder holds another run.
    """
    states = {step.name: state_of(step, plan) for step in steps}
    needed = {name for step in steps if not states[step.name].done for name in step.needs}
    for step in steps:
        if step.kind == "simulate" and step.name not in needed:
            states[step.name] = State(True, 1.0)  # removed after it was used
        if step.kind == "report" and not all(states[name].done for name in step.needs):
            states[step.name] = State(False)  # there will be more to show
    return states
