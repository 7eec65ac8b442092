"""Callbacks that end or spoil a training when a test says so, and that watch one."""

import json
import os
import signal
from pathlib import Path

from lightning.pytorch.callbacks import Callback

from acwm_core.training.optimizers import local


class Killed(Exception):
    """What `Kill` raises, unlike any error of ours."""


class Kill(Callback):
    """Ends training before a batch, or in a validation from that batch on, when a test says so."""

    batch: int | None = None
    in_validation = False
    error: type[BaseException] = Killed

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if not self.in_validation and trainer.fit_loop.total_batch_idx == self.batch:
            raise self.error

    def on_validation_batch_start(self, trainer, *_):
        reached = self.batch is not None and trainer.fit_loop.total_batch_idx >= self.batch
        if self.in_validation and reached:
            raise self.error


class Die(Callback):
    """Ends this process by SIGKILL before a batch."""

    def __init__(self, batch: int) -> None:
        self._batch = batch

    def on_train_batch_start(self, trainer, *_):
        if trainer.fit_loop.total_batch_idx == self._batch and not os.environ.get("SPARED"):
            os.kill(os.getpid(), signal.SIGKILL)


class Signal(Callback):
    """Sends this process a signal before a batch, or within a validation from that batch on."""

    def __init__(
        self, batch: int, rank: int = 0, number: int = signal.SIGTERM, validation: bool = False
    ) -> None:
        self._batch, self._rank, self._number, self._validation = batch, rank, number, validation

    def on_train_batch_start(self, trainer, *_):
        if not self._validation and trainer.fit_loop.total_batch_idx == self._batch:
            self._send(trainer)

    def on_validation_batch_start(self, trainer, *_):
        if self._validation and trainer.fit_loop.total_batch_idx == self._batch:
            self._send(trainer)

    def _send(self, trainer):
        if trainer.global_rank == self._rank and not os.environ.get("SPARED"):
            os.kill(os.getpid(), self._number)


class Stop(Callback):
    """Asks for the end of training after a batch, as Lightning's Timer does."""

    def __init__(self, batch: int) -> None:
        self._batch = batch

    def on_train_batch_end(self, trainer, *_):
        if trainer.fit_loop.total_batch_idx == self._batch and not os.environ.get("SPARED"):
            trainer.should_stop = True


class Poison(Callback):
    """Makes the loss of a batch infinite through its actions, on one rank."""

    def __init__(self, batch: int, rank: int = 0) -> None:
        self._batch, self._rank = batch, rank

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if batch_idx == self._batch and trainer.global_rank == self._rank:
            batch["actions"].mul_(float("inf"))


class Witness(Callback):
    """Writes down the first action of every clip that a rank trains on, one line per batch."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        with (self._folder / f"rank-{trainer.global_rank}.jsonl").open("a") as file:
            file.write(json.dumps(batch["actions"][:, 0].tolist()) + "\n")


class Weigh(Callback):
    """Writes down the bytes that this rank holds of weights, gradients, moments and averages."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)

    def on_before_optimizer_step(self, trainer, pl_module, optimizer):
        states = [value for state in optimizer.state.values() for value in state.values()]
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        held = {
            "weights": parameters,
            "gradients": [parameter.grad for parameter in parameters],
            "optimizer": [value for value in states if value.ndim],  # not the numbers of steps
            "average": [
                *pl_module.averaged.model.parameters(),
                *pl_module.averaged.conditioner.parameters(),
            ],
        }
        if trainer.global_step:
            sizes = {name: sum(local(t).nbytes for t in tensors) for name, tensors in held.items()}
            (self._folder / f"rank-{trainer.global_rank}.json").write_text(json.dumps(sizes))
