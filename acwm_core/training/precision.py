"""The precision of a run: the one asked for, else the one it began with, else what is fast."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from acwm_core.errors import AcwmWarning
from acwm_core.model.precision import bfloat16_is_fast, bfloat16_slowdown, gpu_has_bfloat16
from acwm_core.recipe import Recipe
from acwm_core.training.checkpoints import read_details

PRECISION = "precision"
"""Name of the flag of Lightning's Trainer, and of the entry in a checkpoint."""

_CANONICAL = {"16": "16-mixed", "bf16": "bf16-mixed", "32": "32-true", "64": "64-true"}


class RecordedPrecision(Callback):
    """Writes the precision of a run into its checkpoints, so that it is kept when it is resumed."""

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Add it to the checkpoint."""
        checkpoint[PRECISION] = trainer.precision


def canonical(precision: object) -> str:
    """Lightning's own name of a precision, e.g. ``32-true`` for 32."""
    return _CANONICAL.get(str(precision), str(precision))


def automatic_precision(accelerator: object) -> str:
    """`bf16-mixed` where it is faster than `32-true`, by what the hardware can do.

    Args:
        accelerator: the flag of Lightning's Trainer.
    """
    if _uses_gpu(accelerator):
        return "bf16-mixed" if gpu_has_bfloat16() else "32-true"
    is_cpu = accelerator in ("auto", "cpu")
    return "bf16-mixed" if is_cpu and bfloat16_is_fast() else "32-true"


def updates_in_bfloat16(precision: object, device: torch.device) -> bool:
    """Whether Muon may compute its updates in bfloat16: not where that is emulated.

    A CPU does as the run does, whose precision a resumed run keeps.
    """
    if device.type == "cuda":
        return gpu_has_bfloat16()
    return device.type != "cpu" or canonical(precision).startswith("bf16")


def with_recorded_precision(recipe: Recipe, of_run: Recipe, checkpoint: Path) -> Recipe:
    """The recipe, with the precision of the run to resume unless it names one itself.

    Args:
        recipe: the recipe to complete.
        of_run: the recipe of the run; earlier versions recorded a precision nowhere else.
        checkpoint: of the run.
    """
    recorded = read_details(checkpoint).get(PRECISION, of_run.trainer.get(PRECISION))
    precision = recipe.trainer.get(PRECISION, recorded)
    if precision is None:
        return recipe
    return replace(recipe, trainer={**recipe.trainer, PRECISION: canonical(precision)})


def warn_if_emulated(precision: object, accelerator: object) -> None:
    """Warn, with the measured ratio, of a 16-bit precision that this hardware emulates."""
    if canonical(precision) not in ("bf16-mixed", "16-mixed"):
        return
    if _uses_gpu(accelerator):
        device, name = torch.device("cuda"), "GPU"
        emulated = canonical(precision) == "bf16-mixed" and not gpu_has_bfloat16()
    else:
        device, name = torch.device("cpu"), "processor"
        emulated = accelerator in ("auto", "cpu") and not bfloat16_is_fast()
    if emulated:
        warnings.warn(
            f"trainer.precision={precision} is emulated on this {name}: a step takes about "
            f"{bfloat16_slowdown(device):.1f} times as long as with trainer.precision=32-true",
            AcwmWarning,
            stacklevel=2,
        )


def _uses_gpu(accelerator: object) -> bool:
    return accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()
