"""Run tasks on a Ray cluster: one Ray task each, retried by Ray if its worker or node dies."""

from __future__ import annotations

import logging
import socket
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import ray
import ray.exceptions
from ray.job_config import JobConfig

from acwm_core.errors import DataError
from acwm_core.executors import POLL, Executor, Report, Result, Task

RETRIES = 3
"""How often Ray restarts a task whose worker died."""


class RayExecutor(Executor):
    """Runs the tasks as Ray Core tasks of one core each.

    Workers on other nodes need the same packages, and the data folder under the same path, as on a
    shared file system.

    Args:
        folder: not used; every executor is given one.
        workers: cores of a local Ray instance, all available ones by default; on a running cluster
            Ray decides.
        address: address of a running cluster, e.g. ``"auto"`` or ``"10.0.0.1:6379"``; by default a
            local Ray instance is started on this machine and stopped after the run.
    """

    def __init__(
        self, folder: Path | None = None, workers: int | None = None, address: str | None = None
    ) -> None:
        self.address, self.workers = address, workers

    def run(
        self,
        function: Callable[[Task, Report], Result],
        tasks: Sequence[Task],
        report: Report,
    ) -> Iterator[Result]:
        """Yield the results as they arrive; cancels the remaining tasks if interrupted.

        Raises:
            DataError: the cluster cannot be reached, or the worker of a task died repeatedly.
        """
        if not tasks:
            return
        self._connect()
        pending: list[Any] = []
        try:
            remote: Any = ray.remote
            counter = remote(num_cpus=0)(Counter).remote()
            start = remote(num_cpus=1, max_retries=RETRIES)(_run_task)
            pending = [start.remote(function, task, counter) for task in tasks]
            while pending:
                finished, pending = ray.wait(pending, num_returns=1, timeout=POLL)
                report(ray.get(counter.take.remote()))
                for reference in finished:
                    yield _result(reference)
            report(ray.get(counter.take.remote()))
        finally:
            for reference in pending:
                ray.cancel(reference, force=True)
            ray.shutdown()

    def _connect(self) -> None:
        settings: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
        settings["job_config"] = _Job()
        if self.address is None:
            settings |= {"num_cpus": self.workers, "include_dashboard": False}
        try:
            if self.address and ":" in self.address:
                _knock(self.address)  # fail quickly: Ray itself keeps trying for minutes
            ray.init(self.address or "local", **settings)
        except (ValueError, RuntimeError, OSError) as error:
            reason = str(error).splitlines()[0]
            raise DataError(
                f"there is no Ray cluster at {self.address or 'this machine'} ({reason}): start "
                "one with `ray start --head`, or leave out executor.address"
            ) from error


class _Job(JobConfig):
    """A job whose workers import no module from the working folder."""

    def _runtime_env_has_working_dir(self) -> bool:
        return True  # otherwise Ray begins their path with the driver's folders


def _knock(address: str) -> None:
    host, _, port = address.removeprefix("ray://").rpartition(":")
    with socket.create_connection((host, int(port)), timeout=10):
        pass


class Counter:
    """An actor on the cluster that counts the units of work done by tasks."""

    def __init__(self) -> None:
        self.units = 0

    def add(self, units: int) -> None:
        """Add `units`."""
        self.units += units

    def take(self) -> int:
        """The units since the last call."""
        units, self.units = self.units, 0
        return units


def _run_task(function: Callable[[Task, Report], Result], task: Task, counter: Any) -> Result:
    return function(task, counter.add.remote)


def _result(reference: Any) -> Any:
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause from None  # as the task raised it
    except ray.exceptions.RayError as error:
        raise DataError(
            "a Ray worker died repeatedly, perhaps out of memory: see Ray's "
            "logs, and run the same command again to resume"
        ) from error
