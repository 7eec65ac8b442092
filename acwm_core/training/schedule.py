"""The learning rate over the course of training."""

from __future__ import annotations

import math

from acwm_core.errors import TrainingError
from acwm_core.training.config import TrainingConfig


def learning_rate_factor(step: int, config: TrainingConfig, max_steps: int) -> float:
    """What the peak learning rate is multiplied by in optimiser step `step` (from 0).

    Rises linearly over `warmup_steps` (the first step already moves), holds, and falls from
    `decay_start · max_steps` to 0 at `max_steps`, in a line or half a cosine.

    Args:
        step: optimiser steps done before.
        config: warm-up, schedule and where the decay starts.
        max_steps: length of training; used by the decaying schedules only.
    """
    warmup = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    if config.schedule == "constant":
        return warmup
    start = config.decay_start * max_steps
    progress = min(1.0, max(0.0, (step - start) / (max_steps - start)))
    if config.schedule == "linear":
        return warmup * (1 - progress)
    return warmup * 0.5 * (1 + math.cos(math.pi * progress))


def require_length(config: TrainingConfig, max_steps: int) -> None:
    """Refuse a decaying schedule of a training without a known length.

    Raises:
        TrainingError: the schedule decays and `trainer.max_steps` is not set (-1).
    """
    if config.schedule != "constant" and max_steps <= 0:
        raise TrainingError(
            f"training.schedule={config.schedule} falls to 0 at trainer.max_steps; set "
            "trainer.max_steps=…, or training.schedule=constant"
        )
