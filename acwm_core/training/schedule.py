"""The learning rate of a run that is resumed with another length."""

from __future__ import annotations

import warnings
from typing import cast

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from torch.optim.lr_scheduler import LambdaLR

from acwm_core.errors import AcwmWarning
from acwm_core.training.module import TrainingModule


class ResumedSchedule(Callback):
    """Follows the schedule of the new `trainer.max_steps` from the very step of a resume.

    A checkpoint holds the learning rate of the next step by the schedule of before. Where a
    schedule ends with training, another length is another schedule; that is reported.

    Args:
        before: `trainer.max_steps` of the run until now, if it is resumed.
    """

    def __init__(self, before: int | None) -> None:
        self._before = before

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Set the learning rate of the next step."""
        assert isinstance(pl_module, TrainingModule)
        if self._before in (None, trainer.max_steps):
            return
        schedule = cast(LambdaLR, trainer.lr_scheduler_configs[0].scheduler)
        groups = schedule.optimizer.param_groups
        before = float(groups[0]["lr"])
        for group, peak, factor in zip(groups, schedule.base_lrs, schedule.lr_lambdas, strict=True):
            group["lr"] = peak * factor(schedule.last_epoch)
        if trainer.is_global_zero:
            self._report(trainer, pl_module, before, float(groups[0]["lr"]))

    def _report(self, trainer: Trainer, module: TrainingModule, before: float, now: float) -> None:
        config, step, steps = module.config, trainer.global_step, trainer.max_steps
        changes = list[str]()
        if now != before:
            changes.append(
                f"the learning rate goes from {before:.3g} to {now:.3g} at step {step}, as "
                f"training.schedule={config.schedule} spans all steps"
            )
        growth = config.growing_horizon
        if growth and min(step, growth * (self._before or 0)) < min(step, growth * steps):
            changes.append(
                f"clips are shorter again until step {growth * steps:.0f} "
                f"(training.growing_horizon={growth:g})"
            )
        if changes:
            what = f"trainer.max_steps was {self._before}, is {steps}"
            warnings.warn(f"{what}: {'; '.join(changes)}", AcwmWarning, stacklevel=2)
