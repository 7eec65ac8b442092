"""The progress of a training in a terminal, or in lines of a log file."""

from __future__ import annotations

import time
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

LINE_EVERY_S = 30.0
"""Seconds between progress lines if the output is no terminal and cannot show a bar."""


class StepProgress(ProgressBar):
    """Shows steps, losses, steps per second and the time left; plain lines in a file or pipe.

    Lightning's own bars count batches of an epoch, which never ends here, and flood log files.
    """

    def __init__(self) -> None:
        super().__init__()
        self._console = Console(stderr=True)
        text = "{task.completed}/{task.total} steps  {task.fields[numbers]}"
        columns = (TextColumn("training"), BarColumn(), TextColumn(text), TimeRemainingColumn())
        self._bar = Progress(*columns, console=self._console)
        self._started_at = self._printed_at = 0.0
        self._first_step = 0

    def disable(self) -> None:
        """Show nothing (used on all ranks but the first)."""
        self._console.quiet = True

    def enable(self) -> None:
        """Show output again."""
        self._console.quiet = False

    def print(self, *args: Any, **kwargs: Any) -> None:
        """Print above the bar."""
        self._console.print(*args, highlight=False, soft_wrap=True)

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the bar at the step where training starts or resumes."""
        self._started_at = self._printed_at = time.monotonic()
        self._first_step = trainer.global_step
        trained = sum(p.numel() for p in pl_module.parameters() if p.requires_grad)
        device = trainer.strategy.root_device.type
        threads = f" with {torch.get_num_threads()} threads" if device == "cpu" else ""
        step = f" from step {trainer.global_step}" if trainer.global_step else ""
        self.print(
            f"training {trained / 1e6:.2f} M parameters on {trainer.world_size} × {device}{threads}"
            f"{step} in {trainer.precision}"
        )
        self._bar.disable = self._console.quiet or not self._console.is_terminal
        total = trainer.max_steps if trainer.max_steps > 0 else None
        self._bar.add_task("training", total=total, completed=trainer.global_step, numbers="")
        self._bar.start()

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance."""
        if not self._bar.disable:
            numbers = self._numbers(trainer, pl_module)
            self._bar.update(self._bar.task_ids[0], completed=trainer.global_step, numbers=numbers)
        elif time.monotonic() - self._printed_at > LINE_EVERY_S:
            self._print_line(trainer, pl_module)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave the finished bar on the screen."""
        if self._bar.disable:
            self._print_line(trainer, pl_module)
        self._bar.stop()

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Stop the bar so that the terminal is usable again."""
        self._bar.stop()

    def _print_line(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._printed_at = time.monotonic()
        of = f"/{trainer.max_steps}" if trainer.max_steps > 0 else ""
        self.print(f"step {trainer.global_step}{of}  {self._numbers(trainer, pl_module)}")

    def _numbers(self, trainer: Trainer, pl_module: LightningModule) -> str:
        elapsed = max(time.monotonic() - self._started_at, 1e-9)
        rate = (trainer.global_step - self._first_step) / elapsed
        metrics = self.get_metrics(trainer, pl_module)
        losses = [f"{k} {v:.4g}" for k, v in metrics.items() if isinstance(v, float)]
        return "  ".join([*losses, f"{rate:.3g} steps/s"])
