"""Run the remaining steps of an experiment, here or as batch jobs, and show its progress."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path

from acwm_core.errors import DataError, MissingExtraError, RecipeError
from acwm_core.executors import available_cores, create_executor
from acwm_core.files import held
from acwm_executors.batch import BatchExecutor, JobState
from acwm_experiment.local import LocalRunner
from acwm_experiment.plan import ExperimentPlan
from acwm_experiment.steps import ExperimentStep, all_progress, all_steps, step_progress
from acwm_experiment.table import EXPERIMENT_FILE, Experiment

Say = Callable[[str], None]
"""Prints a line for the user."""


def run_experiment(
    plan: ExperimentPlan, command: Sequence[str], *, jobs: int = 1, say: Say
) -> tuple[int, int, dict[str, str]]:
    """Run the remaining steps of an experiment on this machine.

    Args:
        plan: the experiment.
        command: the command to which the words of a step are appended, see `LocalRunner`.
        jobs: how many steps to run at once, at least 1.
        say: prints a line for the user.

    Returns:
        The number of steps, the number that were done before, and why steps failed, by name.

    Raises:
        DataError: another command or a batch system is already running the experiment.
        TrainingError: a folder holds another run.
    """
    steps = all_steps(plan, None if jobs == 1 else max(1, available_cores() // jobs))
    with _locked_folder(plan, steps) as todo:
        queued = [job.id for job in _jobs(plan).values() if job.state in ("queued", "running")]
        if queued:
            raise DataError(
                f"{len(queued)} jobs of this experiment are in the queue: wait for them, or cancel "
                f"them ({' '.join(queued)})"
            )
        for step in steps:
            if plan.logs.state(step.name) == "running":  # left by a killed command
                plan.logs.set_state(step.name, "")
        runner = LocalRunner(
            command, plan.logs, jobs, say, lambda step: step_progress(step, plan) == 1
        )
        return len(steps), len(steps) - len(todo), runner.run(todo)


def submit_experiment(
    plan: ExperimentPlan,
    command: Sequence[str],
    executor: str,
    options: Mapping[str, object],
    *,
    say: Say,
) -> int:
    """Submit the remaining steps of an experiment that are not queued yet, one job per step.

    If several experiments need the same dataset, one of them makes it and the others use it.

    Args:
        plan: the experiment.
        command: the command to which the words of a step are appended.
        executor: registered name of the executor.
        options: options of the executor.
        say: prints a line for the user.

    Returns:
        The number of new jobs.
    """
    queue = _queue(plan.folder / "jobs" / executor, options)
    with _locked_folder(plan, all_steps(plan)) as todo:
        new = queue.submit(todo, command, plan.logs.folder)
    for name, job in new.items():
        say(f"{name}: job {job}")
    return len(new)


def _queue(folder: Path, options: Mapping[str, object] | None = None) -> BatchExecutor:
    executor = create_executor(folder.name, folder, options=options)
    if not isinstance(executor, BatchExecutor):
        raise RecipeError(
            f"the executor {folder.name!r} takes no jobs that outlive this command: choose "
            "another, or leave out --executor to do the steps here"
        )
    return executor


def _jobs(plan: ExperimentPlan) -> dict[str, JobState]:
    """The states of submitted jobs, by step; batch systems that are not available are skipped."""
    states: dict[str, JobState] = {}
    for folder in sorted((plan.folder / "jobs").glob("*")):
        with contextlib.suppress(RecipeError, MissingExtraError):
            states |= _queue(folder).states()
    return states


@contextlib.contextmanager
def _locked_folder(
    plan: ExperimentPlan, steps: Sequence[ExperimentStep]
) -> Generator[list[ExperimentStep]]:
    """Create and lock the experiment's folder with `experiment.json`, and yield the steps left.

    Raises:
        DataError: the folder holds another experiment, is in use, or cannot be written.
    """
    folder, experiment = plan.folder, plan.experiment
    with contextlib.ExitStack() as stack:
        try:
            plan.logs.folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(held(folder))
            existing = Experiment.read(folder) if (folder / EXPERIMENT_FILE).exists() else None
            if existing and existing.name != experiment.name:
                raise DataError(
                    f"{folder} holds the experiment {existing.name!r}: choose another --out"
                )
            if existing != experiment:
                experiment.write(folder)
        except OSError as error:
            raise DataError(f"cannot write to {folder} ({error.strerror})") from error
        progress = all_progress(steps, plan)
        yield [step for step in steps if progress[step.name] < 1]


def overview(plan: ExperimentPlan) -> Iterator[str]:
    """Lines on the progress of an experiment: one per step and a summary. Changes nothing."""
    steps = all_steps(plan)
    progress, jobs = all_progress(steps, plan), _jobs(plan)
    busy = plan.folder.is_dir()  # whether a command on this or another machine runs the experiment
    with contextlib.suppress(DataError), held(plan.folder) if busy else contextlib.nullcontext():
        busy = False
    for step in steps:
        state, note = _state(plan, step, progress[step.name], jobs.get(step.name), busy=busy)
        yield f"{state:<8} {step.title}" + (f" ({note})" if note else "")
    yield ""
    yield f"{plan.experiment.title}, in {plan.folder}"
    left = sum(share < 1 for share in progress.values())
    yield f"{left} of {len(steps)} steps are left" if left else "nothing is left to do"


def _state(
    plan: ExperimentPlan, step: ExperimentStep, progress: float, job: JobState | None, *, busy: bool
) -> tuple[str, str]:
    if progress == 1:
        return "done", ""
    whole, unit = step.size
    saved = round(progress * whole)
    note = f"{saved} of {whole} {unit}" if saved else ""
    if job and job.state in ("queued", "running"):
        return job.state, f"job {job.id}" + (f", {note}" if note else "")
    state = plan.logs.state(step.name)
    if state == "running" and busy:
        return state, note
    if state == "failed" or (job and job.state == "failed"):
        return "failed", f"{plan.logs.last_line(step.name)}; see {plan.logs.log(step.name)}"
    return "to do", note
