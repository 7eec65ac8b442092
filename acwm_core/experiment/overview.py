"""What an experiment would do, has done and is doing, for people."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from acwm_core.data.atomic import held
from acwm_core.errors import DataError
from acwm_core.executors import available_cores
from acwm_core.experiment.estimate import Estimate, estimate
from acwm_core.experiment.ledger import Ledger
from acwm_core.experiment.local import duration
from acwm_core.experiment.plan import Plan
from acwm_core.experiment.slurm import jobs_in_queue
from acwm_core.experiment.states import State
from acwm_core.experiment.steps import KINDS, Step, all_steps, states_of

DONE, RUNNING, QUEUED, FAILED, TO_DO = "done", "running", "queued", "failed", "to do"


@dataclass(frozen=True)
class Line:
    """A step of the overview.

    Attributes:
        step: which.
        state: `DONE`, `RUNNING`, `QUEUED`, `FAILED` or `TO_DO`.
        note: what there is to say about it.
    """

    step: Step
    state: str
    note: str = ""


@dataclass(frozen=True)
class Overview:
    """All steps of an experiment and the time that is left.

    Attributes:
        plan: the experiment.
        lines: one per step.
        left: for what is not done.
        jobs: at once, for which `left` holds.
    """

    plan: Plan
    lines: Sequence[Line]
    left: Estimate
    jobs: int

    def text(self) -> Iterator[str]:
        """Lines to print: every step, then the numbers of each kind, then the time."""
        file = self.plan.file
        for line in self.lines:
            note = f" ({line.note})" if line.note else ""
            yield f"{line.state:<8} {line.step.title}{note}"
        cells, seeds = len(file.cells), len(file.seeds)
        yield ""
        yield (
            f"{file.title}: {cells} cell{'s' * (cells > 1)}, {seeds} seed{'s' * (seeds > 1)}, "
            f"in {self.plan.folder.path}"
        )
        for kind in KINDS:
            counts = Counter(line.state for line in self.lines if line.step.kind == kind)
            if counts:
                states = (DONE, RUNNING, QUEUED, FAILED, TO_DO)
                told = ", ".join(f"{counts[state]} {state}" for state in states if counts[state])
                yield f"{kind:<9} {counts.total():>3}: {told}"
        yield self._time()

    def _time(self) -> str:
        if not self.left.seconds and not self.left.unknown:
            return "nothing is left to do"
        if not self.left.seconds:
            return "how long it takes is known when the first steps are done"
        more = f", and {self.left.unknown} steps of unknown length" if self.left.unknown else ""
        machine = self.plan.file.measured.machine
        by = "as measured here" if self.left.measured else f"as measured on {machine}"
        at_once = f"{self.jobs} job{'s' * (self.jobs > 1)} at once"
        return f"about {duration(self.left.seconds)} are left with {at_once}{more} ({by})"


def look(plan: Plan, jobs: int = 1) -> Overview:
    """See how far an experiment is, changing nothing.

    Raises:
        DataError: a folder holds another dataset, or SLURM does not answer.
        TrainingError: a folder holds another run.
    """
    ledger = Ledger(plan.folder.logs)
    steps = all_steps(plan)
    states = states_of(steps, plan)
    queue = jobs_in_queue() if any(plan.folder.logs.glob("*.job")) else {}
    at_work = _at_work(plan)
    lines = [_line(step, states[step.name], ledger, queue, at_work=at_work) for step in steps]
    measured, cores = plan.file.measured, available_cores()
    left = estimate(steps, states, ledger, measured, jobs=jobs, cores=cores)
    return Overview(plan, lines, left, jobs)


def _at_work(plan: Plan) -> bool:
    """Whether a command on this or another machine is doing the experiment."""
    if not plan.folder.path.is_dir():
        return False
    try:
        with held(plan.folder.path):
            return False
    except DataError:
        return True


def _line(
    step: Step, state: State, ledger: Ledger, queue: Mapping[str, str], *, at_work: bool
) -> Line:
    if state.done:
        return Line(step, DONE)
    how_far = ""
    if step.kind == "train" and step.run and state.share:
        how_far = f"{round(state.share * step.run.max_steps)} of {step.run.max_steps} steps"
    job = ledger.job_of(step.name)
    if job is not None and job in queue:
        note = ", ".join(filter(None, (f"SLURM job {job}", how_far)))
        return Line(step, RUNNING if queue[job] == "RUNNING" else QUEUED, note)
    if at_work and ledger.running(step.name).exists():
        return Line(step, RUNNING, how_far)
    if ledger.failed(step.name).exists():
        return Line(step, FAILED, f"{ledger.last_words(step.name)}; see {ledger.log(step.name)}")
    return Line(step, TO_DO, how_far)
