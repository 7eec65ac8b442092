"""Executors: map a function over tasks, here or elsewhere."""

from __future__ import annotations

import ast
import contextlib
import inspect
import os
import signal
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import (
    BaseContext,
    ForkServerContext,
    ForkServerProcess,
    SpawnContext,
)
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any, TypeVar

from acwm_core.errors import DataError, RecipeError
from acwm_core.plugins import catalog
from acwm_core.recipe.check import check_component

Task = TypeVar("Task")
Result = TypeVar("Result")

Report = Callable[[int], None]
"""Callback for progress: called with the number of units of work that a task has just finished."""

Function = Callable[[Task, Report], Result]

LINE_EVERY_S = 10.0  # seconds between progress lines if there is no terminal

POLL = 0.2  # seconds between checks of the workers' progress


def duration(seconds: float) -> str:
    """A time in words: ``45 s``, ``12 min``, ``3.4 h``."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5970 else f"{seconds / 3600:.1f} h"


@contextlib.contextmanager
def progress_bar(
    what: str,
    total: int | None,
    *,
    unit: str = "episodes",
    done: int = 0,
    shown: bool = True,
    note: Callable[[], str] = str,
) -> Generator[Report]:
    """Show a progress bar with rate and remaining time; without a terminal, print occasional lines.

    Args:
        what: label of the bar, e.g. what is being made.
        total: total number of units, if it is known.
        unit: what is counted.
        done: number of units finished by earlier runs.
        shown: whether to show it.
        note: what to show beside the rate; it is asked for as often as that is shown.
    """
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
    from rich.progress import TimeRemainingColumn as Remaining

    console = Console(stderr=True)
    shown = shown and done != total
    text = TextColumn(f"{unit} {{task.fields[text]}}")
    with Progress(
        *(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), text, Remaining()),
        console=console,
        disable=not shown or not console.is_terminal,
        speed_estimate_period=600,  # seconds, for several episodes even if they are slow
    ) as bar:
        task = bar.add_task(what, total=total, completed=done, text="")
        line_at = time.monotonic() + LINE_EVERY_S

        def text_now() -> str:
            speed = bar.tasks[0].finished_speed or bar.tasks[0].speed or 0
            rate = f"{speed:.1f}/s" if speed >= 1 else f"{60 * speed:.1f}/min" if speed else ""
            return "  ".join(filter(None, (rate, note())))

        def print_line() -> None:
            finished = int(bar.tasks[0].completed)
            of = finished if total is None else f"{finished}/{total}"
            left = bar.tasks[0].time_remaining
            until = f"  {duration(left)} left" if left else ""
            line = f"{what}  {of} {unit}  {text_now()}{until}"
            console.print(line.rstrip(), highlight=False, soft_wrap=True)

        def report(units: int) -> None:
            nonlocal line_at
            bar.advance(task, units)
            if not bar.disable:
                bar.update(task, text=text_now())
            elif shown and time.monotonic() >= line_at:
                line_at = time.monotonic() + LINE_EVERY_S
                print_line()

        yield report
        if shown and bar.disable:
            print_line()


class Executor(ABC):
    """Runs tasks, e.g. in local processes or on a cluster.

    A registered executor is constructed with `workers`, the number of tasks to run at once (None:
    its own choice), and `folder`, a `pathlib.Path` for its own files beside the data, which it
    creates and removes. Further parameters are options: ``executor.NAME=VALUE`` on the command
    line.
    """

    @abstractmethod
    def run(
        self, function: Function[Task, Result], tasks: Sequence[Task], report: Report
    ) -> Iterator[Result]:
        """Yield ``function(task, report)`` for every task, in order of completion.

        Function and tasks must be importable and picklable. The first exception of a task is raised
        here and stops the other tasks. Closing the iterator stops them, too.

        Raises:
            DataError: a worker died.
        """


def create_executor(
    name: str, folder: Path, workers: int | None = None, options: Mapping[str, Any] | None = None
) -> Executor:
    """Create the executor `name`.

    Args:
        name: registered name.
        folder: folder for its own files.
        workers: how many tasks to run at once.
        options: its further parameters.

    Raises:
        RecipeError: no executor has that name.
        RecipeError: it has no such parameter, a value is invalid, or it cannot work here.
        MissingExtraError: something that it needs is not installed.
    """
    given = dict(options or {})
    for own in {"folder", "workers"} & {*given}:
        raise RecipeError(f"executor.{own} is not an option here: use the command's own option")
    checked = check_component("executor", {"name": name, "folder": str(folder), **given})
    chosen = {"folder": folder, "workers": workers, **{option: checked[option] for option in given}}
    return catalog().component("executor", name).create(**chosen)


class LocalExecutor(Executor):
    """``processes``: runs tasks in processes on this machine.

    Args:
        workers: number of processes, one per available core by default; with 0, tasks run in this
            process, in order.
        folder: unused; this executor has no files of its own.

    Raises:
        RecipeError: the number of workers is negative.
    """

    def __init__(self, workers: int | None = None, folder: Path | None = None) -> None:
        self.workers = available_cores() if workers is None else workers
        if self.workers < 0:
            raise RecipeError(f"the number of workers cannot be {workers}")

    def run(
        self, function: Function[Task, Result], tasks: Sequence[Task], report: Report
    ) -> Iterator[Result]:
        """Yield results as they arrive; stops the workers at once if it is interrupted."""
        if not self.workers or not tasks:
            yield from (function(task, report) for task in tasks)
            return
        context = worker_context(function.__module__)
        heartbeat, lifeline = context.Pipe(duplex=False)
        done_units: SimpleQueue[int] = context.SimpleQueue()
        pool = ProcessPoolExecutor(
            min(self.workers, len(tasks)), context, _start_worker, (heartbeat, done_units)
        )
        try:
            with without_interrupts(context):
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


class _Worker(ForkServerProcess):
    """A process forked from the server, with the variables of the shell as they are now.

    Ctrl-C is for the process that started it.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._environment = dict(os.environ)

    def run(self) -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        os.environ.clear()  # that of the moment when the server was started
        os.environ.update(self._environment)
        super().run()


class _WorkerContext(ForkServerContext):
    Process = _Worker


_server_of: int | None = None
"""The process that started the server."""


def worker_context(*preload: str) -> ForkServerContext | SpawnContext:
    """How worker processes are started.

    Simulators and threads of this process do not survive a fork. So workers are forked from a
    server, a process that does nothing but import the modules `preload`, and only once. They begin
    as new processes where frameworks of the system bear no fork (macOS, Windows), and in a process
    that was forked itself, as its server is not its child.

    Raises:
        DataError: the script that runs would start over in each worker, which imports it.
    """
    _refuse_unguarded_script()
    if sys.platform != "linux" or _server_of not in (None, os.getpid()):
        return SpawnContext()
    context = _WorkerContext()
    context.set_forkserver_preload(["__main__", *preload])
    return context


def _guards(node: ast.AST, line: int) -> bool:
    """Whether a statement keeps a line from being run in processes that import the script."""
    if not isinstance(node, ast.If):
        return False
    names = [part.id for part in ast.walk(node.test) if isinstance(part, ast.Name)]
    if "__name__" not in names:
        return False
    return node.lineno <= line <= (node.end_lineno or line)


def _refuse_unguarded_script() -> None:
    """Refuse a script that does its work as it is imported, as every worker process imports it."""
    main = sys.modules["__main__"]
    file, spec = getattr(main, "__file__", None), getattr(main, "__spec__", None)
    if file is None or (spec is not None and spec.name.rpartition(".")[2] == "__main__"):
        return  # of a console, or of a package: those are not imported
    frame = inspect.currentframe()
    while frame and not (frame.f_globals is vars(main) and frame.f_code.co_filename == file):
        frame = frame.f_back
    while frame and frame.f_code.co_name != "<module>":
        frame = frame.f_back
    if frame is None or frame.f_code.co_filename != file:
        return
    try:
        tree = ast.parse(Path(file).read_text("utf-8"))
    except (OSError, ValueError, SyntaxError):
        return
    if any(_guards(node, frame.f_lineno) for node in ast.walk(tree)):
        return
    raise DataError(
        f"{file} starts worker processes in line {frame.f_lineno}, and each of them imports it "
        'and would start over: put what it does below `if __name__ == "__main__":`, or ask for '
        "no workers (workers=0)"
    )


@contextlib.contextmanager
def without_interrupts(context: BaseContext) -> Generator[None]:
    """Block Ctrl-C for a moment, so that only this process handles it and not its new children.

    Processes of the context that are started in the block inherit the blocked signal, so Ctrl-C
    does not interrupt their start either.
    """
    resource_tracker.ensure_running()  # starting it in the block would unblock Ctrl-C again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        if isinstance(context, ForkServerContext):
            global _server_of
            _server_of = os.getpid()
            forkserver.ensure_running()
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def available_cores() -> int:
    """Number of cores this process may use; under a scheduler, often fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_report: Report = lambda units: None  # noqa: E731  (replaced in every worker process)


def _start_worker(heartbeat: Connection, done_units: SimpleQueue[int]) -> None:
    """Prepare a worker process: it exits as soon as its parent is gone."""
    global _report
    _report = done_units.put

    def die_with_parent() -> None:
        heartbeat.poll(None)  # returns when the parent closes its end, or dies in any way
        os._exit(1)

    threading.Thread(target=die_with_parent, daemon=True).start()


def _run_task(function: Function[Task, Result], task: Task) -> Result:
    return function(task, _report)
