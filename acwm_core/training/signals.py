"""Handles signals that end training early: it saves, says how to resume, and SLURM requeues it.

A signal may reach only one process, or different processes in different steps. So after every step
the processes agree on whether a signal came, and all save the same step together.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
from collections.abc import Generator
from types import FrameType
from typing import Any, cast

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from torch import distributed

from acwm_core.errors import TrainingError
from acwm_core.interrupts import INTERRUPTED
from acwm_core.training.callbacks import stepped
from acwm_core.training.run_folder import RunFolder, resume_command

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
"""Ctrl-C, the usual request to end, and what ``#SBATCH --signal=USR1@120`` sends before the time
limit. SIGUSR1 is last, so that it wins if several came: the job is then requeued.
"""

SAVING = b"\nacwm: saving this step, then stopping; press Ctrl-C again to stop without saving\n"


class StoppedEarly(TrainingError):
    """A signal ended training; its exit code says that it is worth trying again."""

    def __init__(self, message: str, exit_code: int = os.EX_TEMPFAIL) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Preemption(Callback):
    """Saves `last.ckpt` and ends training once any process has received a signal.

    The current step, validation batch or sample video is finished first; an interrupted validation
    is not repeated. A second Ctrl-C stops at once. In a SLURM job, SIGUSR1 also requeues the job.

    Args:
        run: where the checkpoint goes.
    """

    def __init__(self, run: RunFolder) -> None:
        self._run = run
        self._received = 0  # 1 + the signal's place in SIGNALS
        self._trainer: Trainer | None = None
        self._is_training = False
        self._group: Any = None
        self._ending: StoppedEarly | None = None

    @contextlib.contextmanager
    def watching(self, trainer: Trainer) -> Generator[None]:
        """Handle the signals while this block trains.

        Raises:
            StoppedEarly: a signal came.
        """
        self._trainer = trainer
        before = {number: signal.getsignal(number) for number in SIGNALS}
        _handle(dict.fromkeys(SIGNALS[1:], self._receive))  # before training, Ctrl-C ends at once
        try:
            yield
        except StoppedEarly as stopped:
            queue = self._received > SIGNALS.index(signal.SIGUSR1) and "SLURM_JOB_ID" in os.environ
            if queue and trainer.is_global_zero:
                raise StoppedEarly(f"{stopped}; {requeued()}", stopped.exit_code) from None
            raise
        finally:
            _handle(before)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Install the handlers again: Lightning has just replaced them with its own."""
        _handle(dict.fromkeys(SIGNALS, self._receive))
        self._is_training = True
        if distributed.is_initialized() and trainer.world_size > 1:
            gloo = distributed.get_backend() == "gloo"  # works without waiting for the GPU
            self._group = None if gloo else cast(Any, distributed).new_group(backend="gloo")

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """End training if it was saved; by now the last step is logged, too."""
        self._end()

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """End training if it was saved, instead of validating."""
        self._end()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save after a step if a signal came, unless training is finished anyway."""
        is_last = trainer.global_step == trainer.max_steps
        if stepped(trainer, batch_idx) and not is_last and self._agree(trainer):
            self._save(trainer)

    def on_validation_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Save during a validation as if it were complete, and end, if a signal came."""
        if self._agree(trainer):
            self._save(trainer)
            self._end()

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT:
            if self._received:
                raise KeyboardInterrupt
            os.write(2, SAVING * cast(Trainer, self._trainer).is_global_zero)
        self._received = max(self._received, 1 + SIGNALS.index(signal.Signals(number)))
        if not self._is_training:
            launcher = cast(Any, self._trainer).strategy.launcher
            if launcher is not None:
                launcher.kill(number)  # the processes that this one started
            raise self.stopped(f"{self._name} came before the first step")

    def _agree(self, trainer: Trainer) -> bool:
        """Whether any process has received a signal; also updates which one."""
        if distributed.is_initialized() and trainer.world_size > 1:
            received = torch.tensor(self._received)
            maximum = distributed.ReduceOp.MAX
            cast(Any, distributed).all_reduce(received, maximum, group=self._group)
            self._received = max(self._received, int(received))
            return bool(received)
        return bool(self._received)

    def _save(self, trainer: Trainer) -> None:
        trainer.save_checkpoint(self._run.last_checkpoint)
        self._ending = self.stopped(f"stopped by {self._name}, saved step {trainer.global_step}")

    def _end(self) -> None:
        if self._ending is not None:
            raise self._ending

    def stopped(self, what: str) -> StoppedEarly:
        """The error for training that ended early; it says how to continue."""
        is_asked = self._received > 1  # a signal other than Ctrl-C
        return StoppedEarly(
            f"{what}; continue with `{resume_command(self._run)}`",
            os.EX_TEMPFAIL if is_asked else INTERRUPTED,
        )

    @property
    def _name(self) -> str:
        number = SIGNALS[self._received - 1]
        return "Ctrl-C" if number == signal.SIGINT else number.name


def _handle(handlers: dict[signal.Signals, Any]) -> None:
    if threading.current_thread() is threading.main_thread():  # only this one can
        for number, handler in handlers.items():
            signal.signal(number, handler)


def requeued() -> str:
    """Requeue this SLURM job; returns a phrase that says so, or why it failed."""
    job = os.environ["SLURM_JOB_ID"]
    if "SLURM_ARRAY_JOB_ID" in os.environ:
        job = f"{os.environ['SLURM_ARRAY_JOB_ID']}_{os.environ['SLURM_ARRAY_TASK_ID']}"
    try:
        subprocess.run(["scontrol", "requeue", job], check=True, capture_output=True, text=True)
    except FileNotFoundError:
        return f"SLURM job {job} was not requeued: there is no command scontrol here"
    except subprocess.CalledProcessError as error:
        return f"SLURM job {job} was not requeued: {error.stderr.strip()}"
    return f"SLURM job {job} was requeued"
