"""The progress bar of training: one bar from the first to the last step."""

from __future__ import annotations

import time
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import ProgressBar
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

LINE_EVERY_S = 30.0
"""Seconds between plain lines where there is no terminal to draw a bar on."""


class StepProgress(ProgressBar):
    """Steps, losses, steps per second and the time left; plain lines in a file or pipe."""

    def __init__(self) -> None:
        super().__init__()
        self._console = Console(stderr=True)
        self._bar: Progress | None = None
        self._enabled = True
        self._started_at = self._printed_at = 0.0
        self._first_step = 0

    def disable(self) -> None:
        """Show nothing (on all ranks but the first)."""
        self._enabled = False

    def enable(self) -> None:
        """Show it again."""
        self._enabled = True

    def print(self, *args: Any, **kwargs: Any) -> None:
        """Print above the bar."""
        if self._enabled:
            self._console.print(*args, highlight=False, soft_wrap=True)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Start the bar at the step where training starts or goes on."""
        self._started_at = self._printed_at = time.monotonic()
        self._first_step = trainer.global_step
        self.print(description(trainer, pl_module))
        if not self._enabled or not self._console.is_terminal:
            return
        self._bar = Progress(
            TextColumn("training"),
            BarColumn(),
            TextColumn("{task.completed}/{task.total} steps  {task.fields[numbers]}"),
            TimeRemainingColumn(),
            console=self._console,
        )
        total = trainer.max_steps if trainer.max_steps > 0 else None
        self._bar.add_task("training", total=total, completed=trainer.global_step, numbers="")
        self._bar.start()

    def on_train_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: Any,
        batch_idx: int,
    ) -> None:
        """Advance."""
        if self._bar is not None:
            task = self._bar.task_ids[0]
            step = trainer.global_step
            self._bar.update(task, completed=step, numbers=self._numbers(trainer, pl_module))
        elif self._enabled and time.monotonic() - self._printed_at > LINE_EVERY_S:
            self._print_line(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Leave the finished bar on the screen."""
        if self._bar is None and self._enabled:
            self._print_line(trainer, pl_module)
        self._stop()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        """Give the terminal back."""
        self._stop()

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def _print_line(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._printed_at = time.monotonic()
        of = f"/{trainer.max_steps}" if trainer.max_steps > 0 else ""
        numbers = self._numbers(trainer, pl_module)
        self._console.print(f"step {trainer.global_step}{of}  {numbers}", highlight=False)

    def _numbers(self, trainer: L.Trainer, pl_module: L.LightningModule) -> str:
        elapsed = max(time.monotonic() - self._started_at, 1e-9)
        rate = (trainer.global_step - self._first_step) / elapsed
        metrics = self.get_metrics(trainer, pl_module)
        losses = [f"{k} {v:.4g}" for k, v in metrics.items() if isinstance(v, float)]
        return "  ".join([*losses, f"{rate:.3g} steps/s"])


def description(trainer: L.Trainer, pl_module: L.LightningModule) -> str:
    """One line on what starts: how much is trained, on what, and from where."""
    trained = sum(p.numel() for p in pl_module.parameters() if p.requires_grad)
    device = trainer.strategy.root_device.type
    threads = f" with {torch.get_num_threads()} threads" if device == "cpu" else ""
    step = f" from step {trainer.global_step}" if trainer.global_step else ""
    return (
        f"training {trained / 1e6:.2f} M parameters on {trainer.world_size} × {device}{threads}"
        f"{step} in {trainer.precision}"
    )
