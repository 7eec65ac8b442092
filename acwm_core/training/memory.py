"""The memory that training needs, computed without a device."""

from __future__ import annotations

from collections.abc import Iterable

from torch import nn

from acwm_core.model.world_model import WorldModel
from acwm_core.training.layers import trained_layers

FLOAT = 4
"""Bytes of a float32, the type of weights and their states, also in mixed precision."""


def state_memory(world_model: WorldModel, sharded_over: int = 1) -> dict[str, int]:
    """Estimate the bytes that training needs on each device; the weights may be on `meta`.

    Activations, the codec and unused memory of the allocator come on top.

    Args:
        world_model: the model to be trained with AdamW.
        sharded_over: number of devices that share the weights (``trainer.strategy=fsdp``); 1 if
            each holds all weights (one device, or ``ddp``).

    Returns:
        Bytes by purpose: the trained `weights`, their `gradients`, the `optimizer`'s two moments,
        the moving `average`, and `gathered`: sharded weights that are temporarily whole, namely
        those outside of layers and their gradient, the running layer, the prefetched one, and a
        layer's gradient.
    """
    trained = [*world_model.model.parameters(), *world_model.conditioner.parameters()]
    # A parameter is cut along its first dimension, and the first device holds the largest part.
    rows = [parameter.shape[0] if parameter.ndim else 1 for parameter in trained]
    held = sum(-(-n // sharded_over) * (p.numel() // n) for n, p in zip(rows, trained, strict=True))
    layers = [_numbers(layer.parameters()) for layer in trained_layers(world_model)]
    outside = _numbers(trained) - sum(layers)
    gathered = 2 * outside + 3 * max(layers, default=0) if sharded_over > 1 else 0
    numbers = {
        "weights": held,
        "gradients": held,
        "optimizer": 2 * held,
        "average": held,
        "gathered": gathered,
    }
    return {name: FLOAT * number for name, number in numbers.items()}


def _numbers(parameters: Iterable[nn.Parameter]) -> int:
    return sum(parameter.numel() for parameter in parameters)
