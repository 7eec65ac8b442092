"""Executors: run one function over many tasks, here or elsewhere, or commands in a batch system."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import shlex
import signal
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

from acwm_core.catalog import catalog
from acwm_core.errors import DataError, RecipeError
from acwm_core.recipe.compose import merge, parse_override
from acwm_core.recipe.validate import check_component

Task = TypeVar("Task")
Result = TypeVar("Result")

Report = Callable[[int], None]
"""Called with a number of units of work whenever a task has done that many more."""

Function = Callable[[Task, Report], Result]

LINE_EVERY_S = 10.0  # seconds between lines of progress where there is no terminal

POLL = 0.2  # seconds between looks at the workers' progress


@contextlib.contextmanager
def progress_bar(what: str, total: int, *, done: int = 0, shown: bool = True) -> Generator[Report]:
    """A bar on the terminal with the rate and the remaining time of this run; else a line at times.

    Args:
        what: is made.
        total: episodes of it.
        done: by earlier runs.
        shown: False for none.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    rate = TextColumn("episodes {task.fields[rate]}")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), rate)
    with Progress(
        *columns,
        Remaining(),
        console=Console(stderr=True),
        disable=not shown or done == total,
        speed_estimate_period=600,  # seconds: several episodes even of a slow environment
    ) as bar:
        task = bar.add_task(what, total=total, completed=done, rate="")
        line_at = time.monotonic() + LINE_EVERY_S

        def report(episodes: int) -> None:
            nonlocal line_at
            bar.advance(task, episodes)
            speed = bar.tasks[0].finished_speed or bar.tasks[0].speed or 0
            told = f"{speed:.1f}/s" if speed >= 1 else f"{60 * speed:.1f}/min" if speed else ""
            bar.update(task, rate=told)
            if not bar.disable and not bar.console.is_terminal and time.monotonic() >= line_at:
                line_at = time.monotonic() + LINE_EVERY_S
                made = int(bar.tasks[0].completed)
                bar.console.print(f"{what}  {made}/{total} episodes  {told}", highlight=False)

        yield report


class Executor(ABC):
    """Runs tasks somewhere.

    A registered one is constructed with `workers`, how many tasks to run at once (None leaves it
    open), and `folder`, a `pathlib.Path` for files of its own beside the data, which it makes and
    removes. Further parameters are options: ``executor.NAME=VALUE`` on the command line.
    """

    @abstractmethod
    def run(
        self, function: Function[Task, Result], tasks: Sequence[Task], report: Report
    ) -> Iterator[Result]:
        """Yield ``function(task, report)`` for every task, in order of completion.

        Function and tasks must be importable and picklable. The first exception of a task is raised
        here and ends the others. So does closing the iterator.

        Raises:
            DataError: a worker died.
        """


JobKind = Literal["simulate", "train", "evaluate", "report"]
"""What a job does, by which options of a batch system may differ."""


@dataclass(frozen=True)
class Job:
    """A command of `acwm` that a batch system runs when its turn comes.

    Attributes:
        name: of it and of its log.
        kind: of simulations of one name, one runs at a time; a report begins also if jobs that it
            needs fail; a training is sent SIGUSR1 some minutes before its time is up, and may have
            itself queued again.
        command: the words after ``acwm``.
        needs: names of jobs that have to succeed first; those that are not submitted have.
        nodes: machines that it takes.
        tasks: processes of it on each of them.
        gpus: of each of them.
    """

    name: str
    kind: JobKind
    command: tuple[str, ...]
    needs: tuple[str, ...] = ()
    nodes: int = 1
    tasks: int = 1
    gpus: int = 0

    @property
    def shown(self) -> str:
        """The command as one would type it, after a prompt."""
        return f"$ {shlex.join(('acwm', *self.command))}"


class JobState(NamedTuple):
    """How far a job is: its id, and whether it waits, runs, or what came of it."""

    id: str
    state: Literal["queued", "running", "failed", "ended"]


class BatchExecutor(Executor):
    """One that also takes commands which wait for each other, and outlive this process.

    It remembers in its folder what was submitted.
    """

    @abstractmethod
    def submit(self, jobs: Sequence[Job], program: Sequence[str], logs: Path) -> Mapping[str, str]:
        """Queue those of `jobs` that are not in the queue, each after those that it needs.

        One in the queue that needs a job which is queued anew is so, too.

        Args:
            jobs: each after those that it needs.
            program: what runs ``acwm``.
            logs: folder of the files ``NAME.log``; the time, `Job.shown` and what the job prints
                are appended to them.

        Returns:
            The ids of the new jobs, by name.

        Raises:
            DataError: one is refused; those before it stay in the queue.
        """

    @abstractmethod
    def states(self) -> Mapping[str, JobState]:
        """The last job of each name that was submitted from its folder.

        Raises:
            DataError: the batch system does not answer.
        """


def create_executor(
    name: str, folder: Path, workers: int | None = None, options: Mapping[str, Any] | None = None
) -> Executor:
    """The executor of that name.

    Args:
        name: a registered one.
        folder: for files of its own.
        workers: how many tasks to run at once.
        options: further parameters of it.

    Raises:
        UnknownNameError: there is none of that name.
        RecipeError: it has no such parameter, takes no such value, or cannot work here.
        MissingExtraError: what it needs is not installed.
    """
    given = dict(options or {})
    for own in {"folder", "workers"} & {*given}:
        raise RecipeError(f"executor.{own} is not an option here: use the command's own option")
    checked = check_component("executor", {"name": name, "folder": str(folder), **given})
    chosen = {"folder": folder, "workers": workers, **{option: checked[option] for option in given}}
    return catalog().component("executor", name).create(**chosen)


def split_options(
    overrides: Sequence[str], section: str = "executor"
) -> tuple[list[str], dict[str, Any]]:
    """Overrides of anything else, and what ``executor.NAME=VALUE`` sets in a section.

    Raises:
        RecipeError: a value that is no YAML.
    """
    own = [override for override in overrides if override.startswith(f"{section}.")]
    options: dict[str, Any] = {}
    for override in own:
        options = merge(options, parse_override(override)[section])
    return [override for override in overrides if override not in own], options


class LocalExecutor(Executor):
    """``processes``: runs the tasks in processes of this machine.

    Args:
        workers: number of processes, one per available core by default; with 0, tasks run in this
            process, in their order.
        folder: for files of its own, of which it has none.

    Raises:
        RecipeError: a negative number.
    """

    def __init__(self, workers: int | None = None, folder: Path | None = None) -> None:
        self.workers = available_cores() if workers is None else workers
        if self.workers < 0:
            raise RecipeError(f"the number of workers cannot be {workers}")

    def run(
        self, function: Function[Task, Result], tasks: Sequence[Task], report: Report
    ) -> Iterator[Result]:
        """Yield the results as they come; ends the workers at once if it is interrupted."""
        if not self.workers or not tasks:
            yield from (function(task, report) for task in tasks)
            return
        context = multiprocessing.get_context("spawn")  # simulators that were forked hang
        heartbeat, lifeline = context.Pipe(duplex=False)
        done_units: SimpleQueue[int] = context.SimpleQueue()
        pool = ProcessPoolExecutor(
            min(self.workers, len(tasks)), context, _start_worker, (heartbeat, done_units)
        )
        try:
            with without_interrupts():
                pending = {pool.submit(_run_task, function, task) for task in tasks}
            while pending:
                finished: set[Future[Result]]
                finished, pending = wait(pending, timeout=POLL, return_when=FIRST_COMPLETED)
                while not done_units.empty():
                    report(done_units.get())
                for future in finished:
                    yield future.result()
        except BrokenProcessPool as error:
            raise DataError(
                "a worker process died, perhaps out of memory: run the same command again "
                "to resume, with fewer --workers if it happens again"
            ) from error
        except BaseException:
            lifeline.close()  # ends the workers in the middle of their tasks
            raise
        finally:
            pool.shutdown(cancel_futures=True)
            lifeline.close()


@contextlib.contextmanager
def without_interrupts() -> Generator[None]:
    """Hold Ctrl-C back for a moment; processes that are started meanwhile leave it to this one.

    They inherit the blocked signal, and so are not interrupted while they start, either.
    """
    resource_tracker.ensure_running()  # it would let Ctrl-C through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def available_cores() -> int:
    """Cores this process may use, which under a scheduler can be fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_report: Report = lambda units: None  # noqa: E731  (replaced in every worker process)


def _start_worker(heartbeat: Connection, done_units: SimpleQueue[int]) -> None:
    """Prepare a worker: die as soon as the parent is gone."""
    global _report
    _report = done_units.put

    def die_with_parent() -> None:
        heartbeat.poll(None)  # returns when the parent closes its end, or dies in any way
        os._exit(1)

    threading.Thread(target=die_with_parent, daemon=True).start()


def _run_task(function: Function[Task, Result], task: Task) -> Result:
    return function(task, _report)
