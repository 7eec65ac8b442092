"""Run tasks as elements of SLURM array jobs, and commands as separate jobs, with submitit."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import submitit
from submitit.core.utils import FailedJobError, FailedSubmissionError

from acwm_core.errors import DataError, RecipeError
from acwm_core.executors import Report, Result, Task
from acwm_executors.batch import BatchExecutor, Job, JobKind, JobState

ATTEMPTS = 3
"""Most arrays that are submitted; the later ones run tasks that earlier ones did not finish."""

MAX_ELEMENTS = 1000
"""Most elements of an array; SLURM allows 1001 by default. An element may run several tasks."""

NOTICE = 300
"""Seconds before its time limit at which a training saves and requeues itself."""

PATIENCE = 30.0
"""Seconds to wait for results on a slow file system after an array has left the queue."""

POLL = 5.0
"""Seconds between checks of results and queue."""


class SlurmExecutor(BatchExecutor):
    """Submits array jobs with one core per element and waits for them, or submits single jobs.

    submitit's files are in `folder`, on a file system shared by all nodes: the input and result of
    each job. Beside them are, for tasks, their logs and ``units-*`` with one byte per unit of work;
    for single jobs ``NAME.job`` with the id and log of the last job of that name.

    Args:
        folder: folder for these files; removed when all tasks are done.
        workers: most elements that run at once; as many as the cluster allows by default.
        sbatch: options for ``sbatch``, e.g. ``"--partition=cpu --time=04:00:00"``.
        steps: further options for some kinds of jobs, e.g. ``{"train": "--gpus-per-node=8"}``.

    Raises:
        RecipeError: this machine has no ``sbatch``, or the options cannot be parsed.
    """

    def __init__(
        self,
        folder: Path,
        workers: int | None = None,
        sbatch: str = "",
        steps: dict[JobKind, str] | None = None,
    ) -> None:
        if shutil.which("sbatch") is None or shutil.which("srun") is None:
            raise RecipeError(
                "this machine has no sbatch: run the command where jobs are submitted to SLURM, "
                "or choose another --executor"
            )
        for options in (sbatch, *(steps or {}).values()):
            try:
                shlex.split(options)
            except ValueError as error:
                raise RecipeError(f"options of sbatch {options}: {error}".lower()) from None
        self.folder, self.workers = folder.resolve(), workers
        self.sbatch = sbatch
        self.steps: dict[JobKind, str] = steps or {}

    def run(
        self,
        function: Callable[[Task, Report], Result],
        tasks: Sequence[Task],
        report: Report,
    ) -> Iterator[Result]:
        """Yield the results as they arrive; cancels the array if interrupted.

        Raises:
            DataError: a job of an earlier command is still running, SLURM refuses a job, or tasks
                are missing after the last attempt.
        """
        self._refuse_another()
        shutil.rmtree(self.folder, ignore_errors=True)
        if not tasks:
            return
        self.folder.mkdir(parents=True, mode=0o700)
        missing = list(range(len(tasks)))
        for _ in range(ATTEMPTS):
            job, elements = self._submit_array(function, tasks, missing)
            try:
                for index, result in self._results(job, elements, report):
                    missing.remove(index)
                    if isinstance(result, Exception):
                        raise result
                    yield result
            except BaseException:
                _cancel(job)
                raise
            if not missing:
                shutil.rmtree(self.folder)
                return
        raise DataError(
            f"{len(missing)} of {len(tasks)} tasks have no result after {ATTEMPTS} SLURM "
            f"arrays: see {self.folder}/*_log.out, and run the same command again to resume"
        )

    def _refuse_another(self) -> None:
        """Raise DataError if an array of an earlier, killed command is still in the queue."""
        before = {file.name.partition("_")[0] for file in self.folder.glob("*_submission.sh")}
        for job in sorted(before & _queue().keys() if before else ()):
            raise DataError(
                f"SLURM job {job} of an earlier command is still running: wait for it, or end it "
                f"with `scancel {job}`"
            )

    def _submit_array(
        self, function: Callable[..., Any], tasks: Sequence[Any], indices: Sequence[int]
    ) -> tuple[str, list[submitit.Job[Any]]]:
        count = min(len(indices), MAX_ELEMENTS)
        shares = [indices[element::count] for element in range(count)]
        submitted = self._submit(
            lambda launcher: launcher.map_array(
                _run_tasks,
                [function] * count,
                [{index: tasks[index] for index in share} for share in shares],
                [self.folder] * count,
            ),
            job_name="acwm",
            cpus_per_task=1,
            array_parallelism=self.workers or MAX_ELEMENTS,
            use_srun=False,
        )
        return submitted[0].job_id.partition("_")[0], submitted

    def _submit(
        self, how: Callable[[Any], Any], *setup: str, kind: JobKind | None = None, **parameters: Any
    ) -> Any:
        """Submit with the user's options, which come last and so take precedence.

        submitit has parameters for some options only. Its own default time limit is left out.
        """
        launcher = submitit.SlurmExecutor(self.folder, python=f"{shlex.quote(sys.executable)} -P")
        options = (self.sbatch, self.steps.get(kind) if kind else None)
        lines = [*(f"#SBATCH {each}" for each in options if each), *setup]
        launcher.update_parameters(
            time=None, wckey=None, stderr_to_stdout=True, setup=lines, **parameters
        )
        try:
            return how(launcher)
        except (FailedJobError, FailedSubmissionError) as error:
            reason = " ".join(str(error).split())
            raise DataError(f"sbatch refuses the job: {reason}") from error

    def _results(
        self, job: str, elements: Sequence[submitit.Job[Any]], report: Report
    ) -> Iterator[tuple[int, Any]]:
        """Yield indices and results of finished tasks until all are done or the job has ended."""
        waiting = list(elements)
        ended: float | None = None
        done = self._units()
        while waiting:
            time.sleep(POLL)
            if ended is None and job not in _queue():
                ended = time.monotonic()
            before, done = done, self._units()
            report(done - before)
            for element in [each for each in waiting if each.paths.result_pickle.exists()]:
                waiting.remove(element)
                yield from element.result().items()
                ended = None
            if ended is not None and time.monotonic() - ended >= PATIENCE:
                return

    def _units(self) -> int:
        return sum(file.stat().st_size for file in self.folder.glob("units-*"))

    def submit(self, jobs: Sequence[Job], program: Sequence[str], logs: Path) -> Mapping[str, str]:
        self.folder.mkdir(parents=True, exist_ok=True)
        states = self.states()
        ids = {name: job.id for name, job in states.items() if job.state in ("queued", "running")}
        new: dict[str, str] = {}
        for job in jobs:
            if job.name in ids and new.keys() & {*job.needs}:  # it still waits for old jobs
                _cancel(ids.pop(job.name))
            if job.name not in ids:
                log = str(logs.absolute() / f"{job.name}.log")
                new[job.name] = ids[job.name] = self._submit_job(job, program, log, ids)
                (self.folder / f"{job.name}.job").write_text(f"{ids[job.name]} {log}", "utf-8")
        return new

    def _submit_job(
        self, job: Job, program: Sequence[str], log: str, ids: Mapping[str, str]
    ) -> str:
        extra: dict[str, Any] = {"output": log, "requeue": True, "kill-on-invalid-dep": "yes"}
        if job.kind == "train":
            extra["signal"] = f"USR1@{NOTICE}"
        after = [ids[name] for name in job.needs if name in ids]
        condition = "afterany" if job.kind == "report" else "afterok"
        waits = ":".join([condition, *after]) if after else None
        submitted = self._submit(
            lambda launcher: launcher.submit(_become, (*program, *job.command)),
            f'echo "$(date "+%F %T") "{shlex.quote(job.shown)}',
            kind=job.kind,
            job_name=job.name,
            nodes=job.nodes,
            ntasks_per_node=job.tasks,
            gpus_per_node=job.gpus or None,
            dependency="singleton" if job.kind == "simulate" else waits,
            additional_parameters=extra,
            srun_args=["--output", log, "--open-mode", "append"],
        )
        return submitted.job_id

    def states(self) -> Mapping[str, JobState]:
        """The state of the last job of each name; a job that started and ended counts as failed."""
        files = sorted(self.folder.glob("*.job"))
        queue = _queue() if files else {}
        states: dict[str, JobState] = {}
        for file in files:
            job, _, log = file.read_text("utf-8").partition(" ")
            if job in queue:
                state = "running" if queue[job] else "queued"
            else:
                started = Path(log).exists() and Path(log).stat().st_mtime >= file.stat().st_mtime
                state = "failed" if started else "ended"
            states[file.stem] = JobState(job, state)
        return states


def _queue() -> dict[str, bool]:
    """The ids of the user's queued jobs, and whether they are running; an array has one id.

    Raises:
        DataError: SLURM does not answer.
    """
    command = ["squeue", "--me", "--noheader", "--format=%F %T"]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    if process.returncode:
        raise DataError(f"squeue does not answer: {process.stderr.strip()}")
    states = [line.strip().partition(" ") for line in process.stdout.splitlines()]
    return {job: state == "RUNNING" for job, _, state in states if job}


def _cancel(job: str) -> None:
    """Cancel a job, or a whole array."""
    subprocess.run(["scancel", job], capture_output=True, check=False)


def _run_tasks(
    function: Callable[[Any, Report], Any], tasks: Mapping[int, Any], folder: Path
) -> dict[int, Any]:
    """The result of the function for each task of an element, or the exception it raised."""
    results: dict[int, Any] = {}
    for index, task in tasks.items():
        with (folder / f"units-{index}").open("wb", buffering=0) as done:

            def report(units: int, done: Any = done) -> None:
                done.write(b"." * units)

            try:
                results[index] = function(task, report)
            except Exception as error:
                results[index] = error
    return results


def _become(command: Sequence[str]) -> None:
    """Replace this process by the command, so that its signals and exit code are the job's."""
    os.execvp(command[0], [*command])
