"""Run the steps of an experiment as processes on this machine, optionally in parallel."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from datetime import datetime, timedelta
from typing import NamedTuple

from acwm_core.cli.__main__ import ENDS_WITH_INPUT
from acwm_core.executors import available_cores
from acwm_core.interrupts import exit_by_signal
from acwm_experiment.logs import StepLogs
from acwm_experiment.steps import ExperimentStep

PATIENCE = 120.0
"""Seconds that stopped processes have to finish their training step and save."""

POLL = 0.05  # seconds between checks of the processes


class _Running(NamedTuple):
    step: ExperimentStep
    process: subprocess.Popen[bytes]
    started: float
    gpu: str


class LocalRunner:
    """Runs `acwm` commands, each with its own log.

    Args:
        command: the command to which the words of a step are appended; it must respect
            `ENDS_WITH_INPUT`.
        logs: the log and state files of the steps.
        jobs: how many steps to run at once.
        say: prints a line for the user.
        is_done: whether a step has produced its results.
    """

    def __init__(
        self,
        command: Sequence[str],
        logs: StepLogs,
        jobs: int,
        say: Callable[[str], None],
        is_done: Callable[[ExperimentStep], bool],
    ) -> None:
        self._command, self._logs, self._jobs = tuple(command), logs, jobs
        self._say, self._is_done = say, is_done
        gpus = (visible_gpus() if jobs > 1 else []) or [""]
        self._free = [gpus[place % len(gpus)] for place in range(jobs)]
        self._running: list[_Running] = []

    def run(self, steps: Sequence[ExperimentStep]) -> dict[str, str]:
        """Run `steps`, each after the ones that it needs. A failed step does not stop the others.

        Steps that need a failed one are left out, but the report is written from the rest. Ctrl-C
        and SIGTERM stop all processes, which save what they can.

        Returns:
            Why steps failed or were left out, by name.

        Raises:
            KeyboardInterrupt, SystemExit: after such a signal.
        """
        failures: dict[str, str] = {}
        waiting = {step.name: step for step in steps}
        before = signal.signal(signal.SIGTERM, exit_by_signal)
        try:
            while waiting or self._running:
                self._start_what_can(waiting, failures)
                for finished in [each for each in self._running if each.process.poll() is not None]:
                    if reason := self._end(finished):
                        failures[finished.step.name] = reason
                    count = len(steps) - len(waiting) - len(self._running)
                    took = timedelta(seconds=round(time.monotonic() - finished.started))
                    how = f"FAILED after {took}: {reason}" if reason else f"done after {took}"
                    self._say(f"[{count}/{len(steps)}] {finished.step.title}: {how}")
                time.sleep(POLL)
        finally:
            self._stop()
            signal.signal(signal.SIGTERM, before)
        return failures

    def _start_what_can(self, waiting: dict[str, ExperimentStep], failures: dict[str, str]) -> None:
        unsettled = {*waiting, *(each.step.name for each in self._running)}
        for step in [each for each in waiting.values() if not unsettled & {*each.needs}]:
            failed = [name for name in step.needs if name in failures]
            if failed and (step.kind != "report" or len(failed) == len(step.needs)):
                failures[step.name] = f"skipped, because it needs {failed[0]}"
                del waiting[step.name]
            elif self._free:
                with _signals_delayed():  # a process that is not listed yet would not be stopped
                    self._running.append(self._start(step, self._free.pop(0)))
                del waiting[step.name]

    def _start(self, step: ExperimentStep, gpu: str) -> _Running:
        environment = {**os.environ, ENDS_WITH_INPUT: "1"}
        if self._jobs > 1:  # steps side by side share the machine
            threads = max(1, available_cores() // self._jobs)
            environment.setdefault("OMP_NUM_THREADS", str(threads))
        if gpu and step.gpus <= 1:
            environment["CUDA_VISIBLE_DEVICES"] = gpu
        self._say(f"{step.title} …")
        self._logs.set_state(step.name, "running")
        with self._logs.log(step.name).open("ab") as log:
            log.write(f"\n{datetime.now():%Y-%m-%d %H:%M:%S} {step.shown}\n".encode())
            log.flush()
            process = subprocess.Popen(
                [*self._command, *step.command],
                stdin=subprocess.PIPE,  # the step ends when this process ends, however that happens
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,  # Ctrl-C reaches only this process, which stops the steps
            )
        return _Running(step, process, time.monotonic(), gpu)

    def _end(self, finished: _Running) -> str:
        step, reason = finished.step, ""
        with finished.process:  # closes its input
            code = finished.process.wait()
        if code or not self._is_done(step):
            reason = self._logs.last_line(step.name) or "none"
            if code <= 0:  # the last line it printed does not explain the failure
                how = f"by {signal.Signals(-code).name}" if code else "without leaving a result"
                reason = f"ended {how}; the last line of its log: {reason}"
        self._running.remove(finished)
        self._free.append(finished.gpu)
        self._logs.set_state(step.name, "failed" if reason else "")
        return reason

    def _stop(self) -> None:
        """Ask running processes to stop; kill them if they do not or if Ctrl-C is pressed again."""
        count, deadline = len(self._running), time.monotonic() + PATIENCE
        try:
            for each in self._running:
                each.process.terminate()
            if count:
                self._say(f"stopping {count} processes, which save first; Ctrl-C again kills them")
            for each in self._running:
                each.process.wait(max(0.0, deadline - time.monotonic()))
        except (subprocess.TimeoutExpired, KeyboardInterrupt, SystemExit):
            for each in self._running:
                each.process.kill()
        for each in self._running:
            with each.process:
                self._logs.set_state(each.step.name, "")


@contextmanager
def _signals_delayed() -> Generator[None]:
    """Handle Ctrl-C and SIGTERM only at the end of the block."""
    numbers, received = (signal.SIGINT, signal.SIGTERM), list[int]()
    before = [signal.signal(number, lambda n, _: received.append(n)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)
        for number in received[:1]:
            signal.raise_signal(number)


def visible_gpus() -> list[str]:
    """The NVIDIA GPUs that this process may use, in the format of ``CUDA_VISIBLE_DEVICES``."""
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return [name for name in chosen.split(",") if name]
    if shutil.which("nvidia-smi") is None:
        return []
    listing = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=False)
    gpus = [line for line in listing.stdout.splitlines() if line.startswith("GPU ")]
    return [str(number) for number in range(len(gpus))]
