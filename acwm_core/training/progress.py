"""The progress of a training in a terminal, or in lines of a log file."""

from __future__ import annotations

import contextlib
import math
import sys
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import ProgressBar

from acwm_core.executors import progress_bar
from acwm_core.training.callbacks import is_logged, stepped


class StepProgress(ProgressBar):
    """Shows steps, losses, steps per second and the time left; plain lines in a file or pipe.

    Lightning's own bars count batches of an epoch, which never ends here, and flood log files.
    """

    def __init__(self) -> None:
        super().__init__()
        self._shown = True
        self._open = contextlib.ExitStack()
        self._losses = ""

    def disable(self) -> None:
        """Show nothing (used on all ranks but the first)."""
        self._shown = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the bar at the step where training starts or resumes."""
        trained = sum(p.numel() for p in pl_module.parameters() if p.requires_grad)
        device = trainer.strategy.root_device.type
        count = torch.get_num_threads()
        threads = f" with {count} thread{'s' * (count != 1)}" if device == "cpu" else ""
        step = f" from step {trainer.global_step}" if trainer.global_step else ""
        if self._shown:
            print(
                f"training {trained / 1e6:.2f} M parameters on {trainer.world_size} × {device}"
                f"{threads}{step} in {trainer.precision}",
                file=sys.stderr,
            )
        bar = progress_bar(
            "training",
            trainer.max_steps if trainer.max_steps > 0 else None,
            unit="steps",
            done=trainer.global_step,
            shown=self._shown,
            note=lambda: self._losses,
        )
        self._advance = self._open.enter_context(bar)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Advance after the last batch of a step; read the losses when they are logged."""
        if stepped(trainer, batch_idx):
            if is_logged(trainer) or not self._losses:
                self._read_losses(trainer, pl_module)
            self._advance(1)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Leave the finished bar on the screen."""
        self._open.close()

    def on_exception(
        self, trainer: Trainer, pl_module: LightningModule, exception: BaseException
    ) -> None:
        """Stop the bar so that the terminal is usable again."""
        self._open.close()

    def _read_losses(self, trainer: Trainer, pl_module: LightningModule) -> None:
        losses = {"train/loss": float(trainer.callback_metrics.get("train/loss", math.nan))}
        metrics = {**losses, **self.get_metrics(trainer, pl_module)}
        self._losses = "  ".join(f"{k} {v:.4g}" for k, v in metrics.items() if isinstance(v, float))
