"""The steps of an experiment as processes of this machine, some of them side by side."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from types import FrameType

from acwm_core.executors import available_cores
from acwm_core.experiment.ledger import Ledger
from acwm_core.experiment.steps import Step

POLL = 0.1
"""Seconds between looks at the processes."""

PATIENCE = 120.0
"""Seconds in which processes that are asked to stop finish their training step and save."""

ENDING = (signal.SIGINT, signal.SIGTERM)
"""Signals that ask an experiment to end."""

Say = Callable[[str], None]
"""Tells the user a line."""

Failures = dict[str, str]
"""Why steps failed, by name."""


@dataclass
class _Child:
    """A running step.

    Attributes:
        step: which.
        process: of the command; its standard input is a pipe that this process holds, and by whose
            end it learns that this one has died.
        slot: place among those side by side.
        started: in monotonic seconds.
    """

    step: Step
    process: subprocess.Popen[bytes]
    slot: int
    started: float


class LocalRunner:
    """Runs commands of `acwm`, each with a log of its own.

    Args:
        command: what the words of a step are appended to. It must end when its standard input does.
        ledger: for logs and what becomes of steps.
        jobs: how many at once.
        say: tells the user a line.
        is_done: whether a step has left behind what it should.
        is_fresh: whether nothing of a step was done before, so that its time says something.
    """

    def __init__(
        self,
        command: Sequence[str],
        ledger: Ledger,
        jobs: int,
        say: Say,
        is_done: Callable[[Step], bool],
        is_fresh: Callable[[Step], bool],
    ) -> None:
        self._command, self._ledger, self._jobs, self._say = tuple(command), ledger, jobs, say
        self._is_done, self._is_fresh = is_done, is_fresh
        self._children: list[_Child] = []
        self._failures: Failures = {}
        self._signals: list[int] = []
        self._gpus = visible_gpus() if jobs > 1 else []

    def run(self, steps: Sequence[Step]) -> Failures:
        """Do `steps`, each after those among them that it needs; what fails stops no other one.

        A step that needs a failed one is left out, but a report is written of the rest. Ctrl-C and
        SIGTERM stop all processes, which save what they can.

        Returns:
            Why steps failed or were left out.

        Raises:
            KeyboardInterrupt, SystemExit: after such a signal.
        """
        waiting, total = list(steps), len(steps)
        self._failures = {}
        with _noted(self._signals):
            try:
                while waiting or self._children:
                    self._heed_signals()
                    waiting = self._start(waiting)
                    time.sleep(POLL)
                    for child in [c for c in self._children if c.process.poll() is not None]:
                        settled = total - len(waiting) - len(self._children) + 1
                        self._finish(child, f"{settled}/{total}")
            finally:
                self._stop()
        return self._failures

    def _heed_signals(self) -> None:
        if self._signals:
            number = self._signals.pop()
            raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)

    def _start(self, waiting: list[Step]) -> list[Step]:
        """Start what can be started; returns the others."""
        left: list[Step] = []
        unsettled = {step.name for step in waiting} | {c.step.name for c in self._children}
        for step in waiting:
            failed = [name for name in step.needs if name in self._failures]
            if failed and (step.kind != "report" or len(failed) == len(step.needs)):
                self._failures[step.name] = f"left out, as it needs {failed[0]}"
                continue
            if len(self._children) < self._jobs and not unsettled & {*step.needs}:
                self._children.append(self._child(step))
            else:
                left.append(step)
        return left

    def _child(self, step: Step) -> _Child:
        taken = {child.slot for child in self._children}
        slot = next(number for number in range(self._jobs) if number not in taken)
        self._ledger.failed(step.name).unlink(missing_ok=True)
        self._ledger.seconds(step.name).unlink(missing_ok=True)
        shown = shlex.join(("acwm", *step.command))
        with self._ledger.log(step.name).open("ab") as log:
            log.write(f"\n{datetime.now():%Y-%m-%d %H:%M:%S} $ {shown}\n".encode())
            log.flush()
            process = subprocess.Popen(
                [*self._command, *step.command],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, **self._environment(step, slot)},
                start_new_session=True,  # Ctrl-C reaches this process, which asks them to stop
            )
        self._ledger.running(step.name).write_text(f"{process.pid}\n")
        self._say(f"{step.title} …")
        return _Child(step, process, slot, time.monotonic())

    def _environment(self, step: Step, slot: int) -> Mapping[str, str]:
        """Variables by which steps side by side share the machine."""
        if self._jobs == 1:
            return {}
        threads = str(max(1, available_cores() // self._jobs))
        own = {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", threads)}
        if self._gpus and (step.run is None or step.run.gpus <= 1):
            own["CUDA_VISIBLE_DEVICES"] = self._gpus[slot % len(self._gpus)]
        return own

    def _finish(self, child: _Child, count: str) -> None:
        step, code = child.step, child.process.returncode
        self._forget(child)
        took = time.monotonic() - child.started
        if code == 0 and self._is_done(step):
            if self._is_fresh(step):
                self._ledger.seconds(step.name).write_text(f"{took:.1f}\n")
            self._say(f"[{count}] {step.title}: done after {duration(took)}")
            return
        reason = self._ledger.last_words(step.name) or "none"
        if code <= 0:  # what it printed last is no reason
            how = f"by {signal.Signals(-code).name}" if code else "without what it should have made"
            reason = f"ended {how}; its last words: {reason}"
        self._ledger.failed(step.name).write_text(f"{code}\n")
        self._failures[step.name] = reason
        self._say(f"[{count}] {step.title}: FAILED after {duration(took)}: {reason}")

    def _forget(self, child: _Child) -> None:
        self._children.remove(child)
        self._ledger.running(child.step.name).unlink(missing_ok=True)
        if child.process.stdin:
            child.process.stdin.close()

    def _stop(self) -> None:
        """Ask what still runs to stop, and end it if it does not or if Ctrl-C comes again."""
        if not self._children:
            return
        for child in self._children:
            child.process.terminate()
        self._say(f"stopping {len(self._children)} processes, which save first; again to kill them")
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline and not self._signals:
            if all(child.process.poll() is not None for child in self._children):
                break
            time.sleep(POLL)
        for child in list(self._children):
            child.process.kill()
            child.process.wait()
            self._forget(child)


@contextlib.contextmanager
def _noted(received: list[int]) -> Generator[None]:
    """Append signals that ask this process to end to `received`, instead of ending it.

    An exception out of nowhere could come between the start of a process and its record.
    """

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    asked = [n for n in ENDING if signal.getsignal(n) != signal.SIG_IGN]
    before = {number: signal.signal(number, note) for number in asked}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


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


def duration(seconds: float) -> str:
    """``40 s``, ``12 min`` or ``3.4 h``."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
