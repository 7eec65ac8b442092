"""The steps of an experiment as processes of this machine, some of them side by side."""

from __future__ import annotations

import os
import queue
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from datetime import datetime, timedelta
from typing import NoReturn

from acwm_core.executors import available_cores
from acwm_core.experiment import ENDS_WITH_INPUT
from acwm_core.experiment.folder import StepLogs
from acwm_core.experiment.steps import Step

PATIENCE = 120.0
"""Seconds in which processes that are asked to stop finish their training step and save."""

Failures = dict[str, str]
"""Why steps failed or were left out, by name."""


class LocalRunner:
    """Runs commands of `acwm`, each with a log of its own.

    Args:
        command: what the words of a step are appended to; it respects `ENDS_WITH_INPUT`.
        logs: for logs and what becomes of steps.
        jobs: how many at once.
        say: tells the user a line.
        is_done: whether a step has left behind what it should.
    """

    def __init__(
        self,
        command: Sequence[str],
        logs: StepLogs,
        jobs: int,
        say: Callable[[str], None],
        is_done: Callable[[Step], bool],
    ) -> None:
        self._command, self._logs, self._jobs = tuple(command), logs, jobs
        self._say, self._is_done = say, is_done
        self._gpus = visible_gpus() if jobs > 1 else []
        self._free = queue.SimpleQueue[int]()  # places of steps side by side
        for place in range(jobs):
            self._free.put(place)
        self._lock, self._stopping = threading.Lock(), False
        self._processes: list[subprocess.Popen[bytes]] = []

    def run(self, steps: Sequence[Step]) -> Failures:
        """Do `steps`, each after those among them that it needs; what fails stops no other one.

        A step that needs a failed one is left out, but a report is written of the rest. Ctrl-C and
        SIGTERM stop all processes, which save what they can.

        Raises:
            KeyboardInterrupt, SystemExit: after such a signal.
        """
        self._stopping, failures = False, Failures()
        waiting = {step.name: step for step in steps}
        running: dict[Future[tuple[str, timedelta]], Step] = {}
        pool = ThreadPoolExecutor(self._jobs)
        before = signal.signal(signal.SIGTERM, _exit)
        try:
            while waiting or running:
                unsettled = {*waiting, *(step.name for step in running.values())}
                for step in [each for each in waiting.values() if not unsettled & {*each.needs}]:
                    del waiting[step.name]
                    failed = [name for name in step.needs if name in failures]
                    if failed and (step.kind != "report" or len(failed) == len(step.needs)):
                        failures[step.name] = f"left out, as it needs {failed[0]}"
                    else:
                        running[pool.submit(self._do, step)] = step
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    step, (reason, took) = running.pop(future), future.result()
                    count = len(steps) - len(waiting) - len(running)
                    if reason:
                        failures[step.name] = reason
                    end = f"FAILED after {took}: {reason}" if reason else f"done after {took}"
                    self._say(f"[{count}/{len(steps)}] {step.title}: {end}")
        finally:
            self._stop(pool)
            signal.signal(signal.SIGTERM, before)
        return failures

    def _do(self, step: Step) -> tuple[str, timedelta]:
        """Why a step failed, empty if it did not, and how long it took."""
        started, place = time.monotonic(), self._free.get()
        with self._lock:
            if self._stopping:
                return "stopped", timedelta()
            process = self._start(step, place)
        with process:  # closes its input
            code = process.wait()
        self._free.put(place)
        reason = ""
        if code or not self._is_done(step):
            reason = self._logs.last_line(step.name) or "none"
            if code <= 0:  # what it printed last is no reason
                how = f"by {signal.Signals(-code).name}" if code else "without leaving a result"
                reason = f"ended {how}; the last line of its log: {reason}"
        failed = reason and not self._stopping
        self._logs.set_state(step.name, "failed" if failed else "")
        return reason, timedelta(seconds=round(time.monotonic() - started))

    def _start(self, step: Step, place: int) -> subprocess.Popen[bytes]:
        self._say(f"{step.title} …")
        self._logs.set_state(step.name, "running")
        with self._logs.log(step.name).open("ab") as log:
            log.write(f"\n{datetime.now():%Y-%m-%d %H:%M:%S} {step.shown}\n".encode())
            log.flush()
            process = subprocess.Popen(
                [*self._command, *step.command],
                stdin=subprocess.PIPE,  # ends with this process, however it ends
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, ENDS_WITH_INPUT: "1", **self._share(step, place)},
                start_new_session=True,  # Ctrl-C reaches this process, which asks them to stop
            )
        self._processes.append(process)
        return process

    def _share(self, step: Step, place: int) -> Mapping[str, str]:
        """Variables by which steps side by side share the machine."""
        if self._jobs == 1:
            return {}
        threads = str(max(1, available_cores() // self._jobs))
        own = {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", threads)}
        if self._gpus and step.gpus <= 1:
            own["CUDA_VISIBLE_DEVICES"] = self._gpus[place % len(self._gpus)]
        return own

    def _stop(self, pool: ThreadPoolExecutor) -> None:
        """Ask what still runs to stop, and end it if it does not or if Ctrl-C comes again."""
        with self._lock:
            self._stopping = True
        left = [process for process in self._processes if process.poll() is None]
        try:
            for process in left:
                process.terminate()
            if left:
                self._say(f"stopping {len(left)} processes, which save first; again to kill them")
            deadline = time.monotonic() + PATIENCE
            for process in left:
                process.wait(max(0.0, deadline - time.monotonic()))
        except (subprocess.TimeoutExpired, KeyboardInterrupt, SystemExit):
            for process in left:
                process.kill()
        pool.shutdown(cancel_futures=True)


def visible_gpus() -> list[str]:
    """The NVIDIA GPUs that this process may use, as ``CUDA_VISIBLE_DEVICES`` names them."""
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return [name for name in chosen.split(",") if name]
    if shutil.which("nvidia-smi") is None:
        return []
    listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=False)
    lines = listed.stdout.splitlines() if listed.returncode == 0 else []
    return [str(number) for number in range(sum(line.startswith("GPU ") for line in lines))]


def _exit(number: int, _: object) -> NoReturn:
    raise SystemExit(128 + number)
