"""The exponential moving average (EMA) of a world model's weights."""

from __future__ import annotations

import copy

import torch
from torch import nn

from acwm_core.training.gradients import local
from acwm_core.world_model import WorldModel


def averaged_copy(world_model: WorldModel) -> WorldModel:
    """A frozen copy in evaluation mode; it shares the codec, which never changes."""
    averaged = WorldModel(
        world_model.codec,
        copy.deepcopy(world_model.model),
        copy.deepcopy(world_model.conditioner),
        [float(bound) for bound in world_model.action_low],
        [float(bound) for bound in world_model.action_high],
    )
    return averaged.requires_grad_(False).eval()


def decay_at(step: int, decay: float) -> float:
    """The decay of update `step` (from 1), so that early averages forget the initial weights.

    min(decay, (1 + n) / (10 + n)) after n updates, the ramp of TensorFlow's
    ``ExponentialMovingAverage`` and diffusers' ``EMAModel``.
    """
    return min(decay, (1 + step) / (10 + step))


@torch.no_grad()
def update_average(averaged: WorldModel, world_model: WorldModel, decay: float) -> None:
    """average ← decay · average + (1 − decay) · weights, in place; buffers are copied."""
    for part in ("model", "conditioner"):
        mean: nn.Module = getattr(averaged, part)
        current: nn.Module = getattr(world_model, part)
        means = [local(parameter) for parameter in mean.parameters()]
        weights = [local(parameter) for parameter in current.parameters()]
        torch._foreach_lerp_(means, weights, 1 - decay)  # pyright: ignore
        for kept, buffer in zip(mean.buffers(), current.buffers(), strict=True):
            kept.copy_(buffer)
