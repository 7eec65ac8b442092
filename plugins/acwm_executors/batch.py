"""Batch systems: commands that are queued, wait for each other and outlive this process."""

from __future__ import annotations

import shlex
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from acwm_core.executors import Executor

JobKind = Literal["simulate", "train", "evaluate", "plan", "report"]
"""What a job does; batch options may differ by kind."""


@dataclass(frozen=True)
class Job:
    """An `acwm` command for a batch system.

    Attributes:
        name: name of the job and of its log.
        kind: simulations of the same name run one at a time. A report starts even if jobs that it
            needs fail. A training gets SIGUSR1 some minutes before its time limit, and may requeue
            itself.
        command: the words after ``acwm``.
        needs: names of jobs that must succeed first; those not submitted count as succeeded.
        nodes: number of machines.
        tasks: processes per machine.
        gpus: GPUs per machine.
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
        """The command as typed in a shell, after a prompt."""
        return f"$ {shlex.join(('acwm', *self.command))}"


class JobState(NamedTuple):
    """The id of a job, and whether it is queued, is running, failed or ended."""

    id: str
    state: Literal["queued", "running", "failed", "ended"]


class BatchExecutor(Executor):
    """An executor that also queues commands, which wait for each other and outlive this process.

    It records in its folder what was submitted.
    """

    @abstractmethod
    def submit(self, jobs: Sequence[Job], program: Sequence[str], logs: Path) -> Mapping[str, str]:
        """Queue those of `jobs` that are not in the queue, each to start after the jobs it needs.

        If a job is queued again, queued jobs that need it are queued again as well.

        Args:
            jobs: sorted so that each comes after the jobs it needs.
            program: the words that run ``acwm``.
            logs: folder of the files ``NAME.log``; the time, `Job.shown` and the job's output are
                appended to them.

        Returns:
            The ids of the new jobs, by name.

        Raises:
            DataError: a job is refused; those before it stay in the queue.
        """

    @abstractmethod
    def states(self) -> Mapping[str, JobState]:
        """The state of the last job of each name that was submitted from this folder.

        Raises:
            DataError: the batch system does not answer.
        """
