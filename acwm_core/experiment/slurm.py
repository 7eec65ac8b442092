"""The steps of an experiment as SLURM jobs, each of which waits for those that it needs."""

from __future__ import annotations

import shlex
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from acwm_core.errors import DataError, RecipeError
from acwm_core.experiment.ledger import Ledger
from acwm_core.experiment.steps import KINDS, Step

NOTICE = 300
"""Seconds before its time is up in which a training saves and has itself queued again."""

TRY_AGAIN = 75
"""Exit code of a training that has saved and can go on (EX_TEMPFAIL)."""

OptionsByKind = Mapping[str, Sequence[str]]
"""Options for ``sbatch`` by kind of step, and under ``""`` for all."""


class SlurmRunner:
    """Writes and submits a job for each step, and leaves the rest to SLURM.

    Args:
        command: what the words of a step are appended to.
        ledger: for logs and what becomes of steps.
        scripts: folder of the jobs' scripts.
        options: for ``sbatch``.

    Raises:
        RecipeError: this machine has no ``sbatch``.
    """

    def __init__(
        self, command: Sequence[str], ledger: Ledger, scripts: Path, options: OptionsByKind
    ) -> None:
        if shutil.which("sbatch") is None:
            raise RecipeError(
                "this machine has no sbatch: run the command where jobs are submitted to SLURM, "
                "or leave out --slurm"
            )
        self._command, self._ledger = tuple(command), ledger
        self._scripts, self._options = scripts.absolute(), options

    def submit(self, steps: Sequence[Step], say: Callable[[str], None]) -> list[str]:
        """Submit those of `steps` that are not in the queue already, in their order.

        Returns:
            The ids of the new jobs.

        Raises:
            DataError: SLURM refuses one; those before it stay in the queue.
        """
        self._scripts.mkdir(parents=True, exist_ok=True)
        queue = jobs_in_queue()
        jobs: dict[str, str] = {}
        new: dict[str, str] = {}
        for step in steps:
            job = self._ledger.job_of(step.name)
            if job in queue and new.keys() & {*step.needs}:  # it waits for jobs that have ended
                subprocess.run(["scancel", str(job)], capture_output=True, check=False)
                job = None
            if job is None or job not in queue:
                job = self._submit(step, [jobs[name] for name in step.needs if name in jobs])
                say(f"{step.title}: SLURM job {job}")
                new[step.name] = job
            jobs[step.name] = job
        return [*new.values()]

    def _submit(self, step: Step, needs: Sequence[str]) -> str:
        script = self._scripts / f"{step.name}.sh"
        script.write_text(self._script(step))
        options = [*self._options.get("", ()), *self._options.get(step.kind, ())]
        command = ["sbatch", "--parsable", *_dependency(step, needs), *options, str(script)]
        submitted = subprocess.run(command, capture_output=True, text=True, check=False)
        if submitted.returncode:
            raise DataError(
                f"sbatch refuses {step.name}: {submitted.stderr.strip()}; the same command goes on "
                "with what is missing"
            )
        job = submitted.stdout.strip().partition(";")[0]
        self._ledger.failed(step.name).unlink(missing_ok=True)
        self._ledger.job(step.name).write_text(f"{job}\n")
        return job

    def _script(self, step: Step) -> str:
        """The job: resources, the command, and a note of its end."""
        resources = [
            f"--job-name={step.name}",
            f"--output={self._ledger.log(step.name).absolute()}",
            "--open-mode=append",
            "--requeue",
            "--kill-on-invalid-dep=yes",
            *_resources(step),
        ]
        failed, seconds = (
            shlex.quote(str(file(step.name).absolute()))
            for file in (self._ledger.failed, self._ledger.seconds)
        )
        command = shlex.join([*self._command, *step.command])
        shown = shlex.quote(shlex.join(("acwm", *step.command)))
        start = "srun " if step.kind == "train" else ""  # SIGUSR1 goes to what srun starts
        return "\n".join(
            [
                "#!/bin/bash",
                *(f"#SBATCH {resource}" for resource in resources),
                f"cd {shlex.quote(str(Path.cwd()))} || exit 1",
                f"rm -f {failed} {seconds}",
                f'echo "$(date "+%F %T") \\$ "{shown}',
                f"{start}{command}",
                "code=$?",
                f"if [ $code -eq 0 ] && [ ${{SLURM_RESTART_COUNT:-0}} -eq 0 ]; "
                f"then echo $SECONDS > {seconds}; fi",
                f"if [ $code -ne 0 ] && [ $code -ne {TRY_AGAIN} ]; then echo $code > {failed}; fi",
                "exit $code",
                "",
            ]
        )


def _dependency(step: Step, needs: Sequence[str]) -> list[str]:
    """What the job waits for.

    Of several experiments that make the same dataset one does, and the others find it made.
    """
    if step.kind == "simulate":
        return ["--dependency=singleton"]  # one at a time of that name
    condition = "afterany" if step.kind == "report" else "afterok"
    return [f"--dependency={condition}:{':'.join(needs)}"] if needs else []


def _resources(step: Step) -> list[str]:
    """What the step's own recipe says that it takes."""
    gpus = step.run.gpus if step.run else 0
    if step.kind != "train":
        return ["--ntasks=1", *(["--gpus-per-node=1"] if gpus else [])]
    assert step.run is not None
    found = [f"--nodes={step.run.nodes}", f"--ntasks-per-node={max(1, gpus)}"]
    if gpus:
        found.append(f"--gpus-per-node={gpus}")
    return [*found, f"--signal=USR1@{NOTICE}"]


def jobs_in_queue() -> dict[str, str]:
    """The states of this user's SLURM jobs by id; empty on a machine without SLURM.

    Raises:
        DataError: SLURM does not answer.
    """
    if shutil.which("squeue") is None:
        return {}
    command = ["squeue", "--me", "--noheader", "--format=%i %T"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    if found.returncode:
        raise DataError(f"squeue does not answer: {found.stderr.strip()}")
    lines = [line.strip().partition(" ") for line in found.stdout.splitlines()]
    return {job: state for job, _, state in lines if job}


def parse_options(texts: Sequence[str]) -> dict[str, list[str]]:
    """Options by kind of step, from ``"--partition=gpu"`` for all and ``"train=--time=24:00:00"``.

    Raises:
        RecipeError: an unknown kind, or no list of options.
    """
    found: dict[str, list[str]] = {}
    for text in texts:
        kind, equals, options = text.partition("=")
        if text.startswith("-") or not equals:
            kind, options = "", text
        elif kind not in KINDS:
            raise RecipeError(
                f"--sbatch {text}: write options such as --partition=gpu, or KIND=OPTIONS with "
                f"{', '.join(KINDS)}"
            )
        try:
            found.setdefault(kind, []).extend(shlex.split(options))
        except ValueError as error:
            raise RecipeError(f"--sbatch {text}: {error}".lower()) from None
    return found
