"""Doing what is left of an experiment: here, or by SLURM."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from acwm_core.data.atomic import held
from acwm_core.errors import DataError, RecipeError
from acwm_core.executors import available_cores
from acwm_core.experiment.folder import Experiment
from acwm_core.experiment.ledger import Ledger
from acwm_core.experiment.local import Failures, LocalRunner, Say
from acwm_core.experiment.plan import Plan
from acwm_core.experiment.slurm import OptionsByKind, SlurmRunner, jobs_in_queue
from acwm_core.experiment.steps import Step, all_steps, state_of, states_of


@dataclass(frozen=True)
class Outcome:
    """What came of an experiment.

    Attributes:
        steps: how many there are.
        done: how many of them were done before.
        failures: why others failed or were left out, by name.
        ledger: their logs.
    """

    steps: int
    done: int
    failures: Failures
    ledger: Ledger


def run_experiment(plan: Plan, command: Sequence[str], *, jobs: int = 1, say: Say) -> Outcome:
    """Do on this machine what is left of an experiment.

    Args:
        plan: the experiment.
        command: what the words of a step are appended to; it must end with its standard input.
        jobs: how many steps at once.
        say: tells the user a line.

    Raises:
        DataError: another command or SLURM is at it, or a folder holds another dataset.
        TrainingError: a folder holds another run.
        RecipeError: no possible number of jobs.
    """
    if jobs < 1:
        raise RecipeError(f"--jobs {jobs} must be at least 1")
    steps = all_steps(plan, None if jobs == 1 else max(1, available_cores() // jobs))
    ledger = _prepare(plan)
    with held(plan.folder.path):
        for left in plan.folder.logs.glob("*.running"):  # by a command that was killed
            left.unlink()
        states = states_of(steps, plan)
        _refuse_queued(steps, ledger)
        todo = [step for step in steps if not states[step.name].done]
        fresh = {step.name for step in todo if not states[step.name].share}
        runner = LocalRunner(
            command,
            ledger,
            jobs,
            say,
            is_done=lambda step: state_of(step, plan).done,
            is_fresh=lambda step: step.name in fresh,
        )
        failures = runner.run(todo)
    return Outcome(len(steps), len(steps) - len(todo), failures, ledger)


def submit_experiment(
    plan: Plan, command: Sequence[str], options: OptionsByKind, *, say: Say
) -> list[str]:
    """Submit to SLURM what is left of an experiment and not in the queue yet.

    Args:
        plan: the experiment.
        command: what the words of a step are appended to.
        options: for ``sbatch``, by kind of step.
        say: tells the user a line.

    Returns:
        The ids of the new jobs.

    Raises:
        DataError: SLURM refuses a job, another command is at it, or a folder holds another dataset.
        TrainingError: a folder holds another run.
        RecipeError: this machine has no SLURM.
    """
    ledger = Ledger(plan.folder.logs)
    runner = SlurmRunner(command, ledger, plan.folder.scripts, options)
    steps = all_steps(plan)
    _prepare(plan)
    with held(plan.folder.path):
        states = states_of(steps, plan)
        return runner.submit([step for step in steps if not states[step.name].done], say)


def _prepare(plan: Plan) -> Ledger:
    """Make the folder, with `experiment.json` in it, if there is none of another experiment.

    Raises:
        DataError: there is, or it cannot be written.
    """
    folder = plan.folder
    try:
        folder.logs.mkdir(parents=True, exist_ok=True)
        there = Experiment.read(folder.path) if folder.file.exists() else None
        if there and there.name != plan.file.name:
            raise DataError(
                f"{folder.path} holds the experiment {there.name!r}: choose another --out"
            )
        if there != plan.experiment:
            plan.experiment.write(folder.path)
    except OSError as error:
        raise DataError(f"cannot write to {folder.path} ({error.strerror})") from error
    return Ledger(folder.logs)


def _refuse_queued(steps: Sequence[Step], ledger: Ledger) -> None:
    jobs = {step.name: ledger.job_of(step.name) for step in steps}
    queue = jobs_in_queue() if any(jobs.values()) else {}
    queued = [job for job in jobs.values() if job in queue]
    if queued:
        raise DataError(
            f"{len(queued)} SLURM jobs of this experiment are in the queue: wait for them, or "
            f"cancel them with `scancel {' '.join(queued)}`"
        )
