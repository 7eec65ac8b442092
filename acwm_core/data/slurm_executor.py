"""Tasks as the elements of SLURM array jobs, with new arrays for those that did not come back.

The tasks travel by files in a folder of their own, on a file system that all nodes see:

    tasks.pickle        what to do
    job-1.sh, job-2.sh  the array of each attempt
    job.id              of the array that was submitted last
    units-7             a byte for each unit of work that element 7 has done
    result-7.pickle     what became of task 7
    log-1-7.txt         what element 7 printed at attempt 1

`python -m acwm_core.data.slurm_executor FOLDER` is what an element runs.
"""

from __future__ import annotations

import os
import pickle
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from acwm_core.data.atomic import written_whole
from acwm_core.data.executors import Executor, Report, Result, Task
from acwm_core.errors import DataError, RecipeError

ATTEMPTS = 3
"""Arrays that are submitted, the later ones for what the earlier ones left missing."""

LARGEST_ARRAY = 1000
"""Elements of an array; SLURM allows 1001 by default. An element takes several tasks if need be."""


class SlurmExecutor(Executor):
    """Writes, submits and watches array jobs of one core per element.

    Args:
        folder: for the files above; removed when all is done.
        options: for ``sbatch``, e.g. ``"--partition=cpu --time=04:00:00"``.
        workers: the most elements that run at once; as many as the cluster allows by default.
        poll: seconds between looks at results and queue.
        patience: seconds for the files of an array that has left the queue to appear on a slow
            file system.

    Raises:
        RecipeError: this machine has no ``sbatch``, or `options` is no list of options.
        DataError: a job of an earlier command is still at it.
    """

    def __init__(
        self,
        folder: Path,
        options: str = "",
        workers: int | None = None,
        *,
        poll: float = 5.0,
        patience: float = 30.0,
    ) -> None:
        if shutil.which("sbatch") is None:
            raise RecipeError(
                "this machine has no sbatch: run the command where jobs are submitted to SLURM, "
                "or choose another --executor"
            )
        try:
            self.options = shlex.split(options)
        except ValueError as error:
            raise RecipeError(f"--sbatch {options}: {error}".lower()) from None
        self.folder, self.workers = folder.resolve(), workers
        self.poll, self.patience = poll, patience
        job = self.folder / "job.id"
        if job.exists() and in_queue(job.read_text()):
            raise DataError(
                f"SLURM job {job.read_text()} of an earlier command is still at it: wait for it, "
                f"or end it with `scancel {job.read_text()}`"
            )

    def run(
        self,
        function: Callable[[Task, Report], Result],
        tasks: Sequence[Task],
        report: Report,
    ) -> Iterator[Result]:
        """Yield the results as they come; cancels the array if it is interrupted.

        Raises:
            DataError: SLURM refuses the job, or tasks are missing after the last attempt.
        """
        shutil.rmtree(self.folder, ignore_errors=True)
        if not tasks:
            return
        self.folder.mkdir(parents=True, mode=0o700)
        (self.folder / "tasks.pickle").write_bytes(pickle.dumps((function, list(tasks))))
        waiting = set(range(len(tasks)))
        for attempt in range(1, ATTEMPTS + 1):
            job = self._submit(attempt, sorted(waiting))
            try:
                for index in self._watch(job, waiting, report):
                    waiting.remove(index)
                    yield self._result(index)
            except BaseException:
                _slurm("scancel", job)
                raise
            if not waiting:
                shutil.rmtree(self.folder)
                return
        raise DataError(
            f"{len(waiting)} of {len(tasks)} tasks did not come back from {ATTEMPTS} SLURM "
            f"arrays: look into {self.folder}/log-*.txt, and run the same command again to go on"
        )

    def _watch(self, job: str, waiting: set[int], report: Report) -> Iterator[int]:
        """The tasks of `waiting` that come back, until none is left or the job has ended."""
        ended: float | None = None
        done = self._units()
        while waiting:
            time.sleep(self.poll)
            if ended is None and not in_queue(job):
                ended = time.monotonic()
            before, done = done, self._units()
            report(done - before)
            found = [index for index in sorted(waiting) if self._result_file(index).exists()]
            yield from found
            if found:
                ended = None
            elif ended is not None and time.monotonic() - ended >= self.patience:
                return

    def _units(self) -> int:
        return sum(file.stat().st_size for file in self.folder.glob("units-*"))

    def _submit(self, attempt: int, indices: list[int]) -> str:
        elements = min(len(indices), LARGEST_ARRAY)
        (self.folder / f"elements-{attempt}.txt").write_text(
            "".join(" ".join(map(str, indices[e::elements])) + "\n" for e in range(elements))
        )
        script = self.folder / f"job-{attempt}.sh"
        script.write_text(self._script(attempt, elements))
        submitted = _slurm("sbatch", "--parsable", *self.options, str(script))
        if submitted.returncode:
            raise DataError(f"sbatch refuses the job: {submitted.stderr.strip()}")
        job = submitted.stdout.strip().partition(";")[0]
        (self.folder / "job.id").write_text(job)
        return job

    def _script(self, attempt: int, elements: int) -> str:
        most = f"%{self.workers}" if self.workers else ""
        command = [sys.executable, "-m", __name__, str(self.folder), str(attempt)]
        return (
            "#!/bin/bash\n"
            "#SBATCH --job-name=acwm\n"
            f"#SBATCH --array=0-{elements - 1}{most}\n"
            "#SBATCH --cpus-per-task=1\n"
            f"#SBATCH --output={self.folder}/log-{attempt}-%a.txt\n"
            f"exec {shlex.join(command)}\n"
        )

    def _result_file(self, index: int) -> Path:
        return self.folder / f"result-{index}.pickle"

    def _result(self, index: int) -> Any:
        value = pickle.loads(self._result_file(index).read_bytes())
        if isinstance(value, Exception):
            raise value
        return value


def in_queue(job: str) -> bool:
    """Whether SLURM still has the job, waiting or running; if SLURM does not answer, it has."""
    found = _slurm("squeue", "--noheader", "--jobs", job)
    if found.returncode:
        return "invalid job id" not in found.stderr.lower()
    return bool(found.stdout.strip())


def run_element(folder: Path, attempt: int, element: int) -> None:
    """Do the tasks of one element of an array, and leave their results in `folder`."""
    function, tasks = pickle.loads((folder / "tasks.pickle").read_bytes())
    lines = (folder / f"elements-{attempt}.txt").read_text().splitlines()
    for index in map(int, lines[element].split()):
        result = _run_task(function, tasks[index], folder / f"units-{index}")
        with written_whole(folder / f"result-{index}.pickle") as partial:
            partial.write_bytes(pickle.dumps(result))


def _run_task(function: Callable[[Any, Report], Any], task: Any, units_file: Path) -> Any:
    """What the function returns, or the exception it raises."""
    with units_file.open("wb", buffering=0) as done:

        def report(units: int) -> None:
            done.write(b"." * units)

        try:
            return function(task, report)
        except Exception as error:
            return error


def _slurm(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, check=False)


if __name__ == "__main__":
    run_element(Path(sys.argv[1]), int(sys.argv[2]), int(os.environ["SLURM_ARRAY_TASK_ID"]))
