"""Signals that end a training early: it saves, says how to resume, and SLURM queues it again.

A signal may reach one process only, or each in another step. So after every step the processes
agree on whether one came, and all save the same step together.
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

from acwm_core.errors import INTERRUPTED, TrainingError
from acwm_core.training.callbacks import stepped
from acwm_core.training.checkpoints import last_whole
from acwm_core.training.run import RunFolder

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
"""Ctrl-C, what asks a process to end, and what ``#SBATCH --signal=USR1@120`` sends before the time
is up. SIGUSR1 comes last: where several came, the job is queued again.
"""

SAVING = b"\nacwm: saving this step, then stopping; Ctrl-C again stops without it\n"


class StoppedEarly(TrainingError):
    """Training ended because of a signal; its exit code says that it is worth trying again."""

    def __init__(self, message: str, exit_code: int = os.EX_TEMPFAIL) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class Preemption(Callback):
    """Saves `last.ckpt` and ends training as soon as a signal came to one of the processes.

    The step, validation batch or sample video under way is finished first; a validation that is
    cut short is not repeated. A second Ctrl-C does not wait. Within a SLURM job SIGUSR1 also puts
    the job back into the queue.

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
        """Act upon the signals while this block trains.

        Raises:
            StoppedEarly: one came.
        """
        self._trainer = trainer
        before = {number: signal.getsignal(number) for number in SIGNALS}
        _handle(dict.fromkeys(SIGNALS[1:], self._receive))  # Ctrl-C ends what is no training yet
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
        """Handle signals again: Lightning has just put its own handlers in place."""
        _handle(dict.fromkeys(SIGNALS, self._receive))
        self._is_training = True
        if distributed.is_initialized() and trainer.world_size > 1:
            gloo = distributed.get_backend() == "gloo"  # works without waiting for the GPU
            self._group = None if gloo else cast(Any, distributed).new_group(backend="gloo")

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int
    ) -> None:
        """End, now that the last step is logged, too."""
        self._end()

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """End in place of a validation."""
        self._end()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save after a step, unless all is done anyway."""
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
        """Save within a validation, as if it were over, and end."""
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
        """Whether any process has received a signal, and which."""
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
        """The error for a training that ended early; says how to go on."""
        is_asked = self._received > 1  # by more than Ctrl-C
        return StoppedEarly(
            f"{what}; {how_to_resume(self._run)}", os.EX_TEMPFAIL if is_asked else INTERRUPTED
        )

    @property
    def _name(self) -> str:
        number = SIGNALS[self._received - 1]
        return "Ctrl-C" if number == signal.SIGINT else number.name


def how_to_resume(run: RunFolder) -> str:
    """What to do about a run that ended early, as a phrase."""
    saved = last_whole(run.last_checkpoint)
    return f"continue with resume={run.path}" if saved else "start again with resume=auto"


def _handle(handlers: dict[signal.Signals, Any]) -> None:
    if threading.current_thread() is threading.main_thread():  # no other one can
        for number, handler in handlers.items():
            signal.signal(number, handler)


def requeued() -> str:
    """Put this SLURM job back into the queue, and say so or why not."""
    job = os.environ["SLURM_JOB_ID"]
    if "SLURM_ARRAY_JOB_ID" in os.environ:
        job = f"{os.environ['SLURM_ARRAY_JOB_ID']}_{os.environ['SLURM_ARRAY_TASK_ID']}"
    try:
        subprocess.run(["scontrol", "requeue", job], check=True, capture_output=True, text=True)
    except FileNotFoundError:
        return f"SLURM job {job} is not in the queue again: there is no command scontrol here"
    except subprocess.CalledProcessError as error:
        return f"SLURM job {job} is not in the queue again: {error.stderr.strip()}"
    return f"SLURM job {job} is in the queue again"
