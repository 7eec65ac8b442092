"""Executors: run one function over many tasks, here or in a pool of processes.

The function and the tasks must be importable and picklable. Results come as tasks finish, in no
order; a task's own progress comes through `Report`.
"""

from __future__ import annotations

import functools
import multiprocessing
import os
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from multiprocessing.queues import SimpleQueue
from typing import TypeVar

from acwm_core.errors import DataError, RecipeError

Task = TypeVar("Task")
Result = TypeVar("Result")

Report = Callable[[int], None]
"""Called with a number of units of work whenever a task has done that many more."""

POLL = 0.2  # seconds between looks at the workers' progress


class Executor(ABC):
    """Runs tasks somewhere."""

    @abstractmethod
    def run(
        self,
        function: Callable[[Task, Report], Result],
        tasks: Sequence[Task],
        report: Report,
    ) -> Iterator[Result]:
        """Yield ``function(task, report)`` for every task, in order of completion.

        The first exception of a task is raised here and ends the others. So does closing the
        iterator.

        Raises:
            DataError: a worker died.
        """


class SerialExecutor(Executor):
    """Runs the tasks in this process, in order."""

    def run(
        self,
        function: Callable[[Task, Report], Result],
        tasks: Sequence[Task],
        report: Report,
    ) -> Iterator[Result]:
        """Yield the results in the order of the tasks."""
        for task in tasks:
            yield function(task, report)


class ProcessExecutor(Executor):
    """Runs the tasks in spawned processes of this machine.

    Spawned, because simulators that were started before a fork hang in the child.

    Args:
        workers: number of processes, at least 1.
    """

    def __init__(self, workers: int) -> None:
        self.workers = workers

    def run(
        self,
        function: Callable[[Task, Report], Result],
        tasks: Sequence[Task],
        report: Report,
    ) -> Iterator[Result]:
        """Yield the results as they come; ends the workers at once if it is interrupted."""
        if not tasks:
            return
        context = multiprocessing.get_context("spawn")
        heartbeat, lifeline = context.Pipe(duplex=False)
        done_units: SimpleQueue[int] = context.SimpleQueue()
        pool = ProcessPoolExecutor(
            min(self.workers, len(tasks)), context, _start_worker, (heartbeat, done_units)
        )
        try:
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
                "a worker process died, perhaps for want of memory: run the same command again "
                "to go on, with fewer --workers if it happens again"
            ) from error
        except BaseException:
            lifeline.close()  # ends the workers in the middle of their tasks
            raise
        finally:
            pool.shutdown(cancel_futures=True)
            lifeline.close()


def make_executor(workers: int | None) -> Executor:
    """A process pool with `workers` processes, one per available core by default; 0 is serial.

    Raises:
        RecipeError: a negative number.
    """
    if workers is None:
        workers = available_cores()
    if workers < 0:
        raise RecipeError(f"the number of workers cannot be {workers}")
    return ProcessExecutor(workers) if workers else SerialExecutor()


def available_cores() -> int:
    """Cores this process may use, which under a scheduler can be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_report: Report = lambda units: None  # noqa: E731  (replaced in every worker process)


def _start_worker(heartbeat: Connection, done_units: SimpleQueue[int]) -> None:
    """Prepare a worker: leave Ctrl-C to the parent, and die as soon as the parent is gone."""
    global _report
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    watch = functools.partial(_die_with_parent, heartbeat)
    threading.Thread(target=watch, daemon=True).start()
    _report = done_units.put


def _die_with_parent(heartbeat: Connection) -> None:
    heartbeat.poll(None)  # returns when the parent closes its end, or dies in any way
    os._exit(1)


def _run_task(function: Callable[[Task, Report], Result], task: Task) -> Result:
    return function(task, _report)
