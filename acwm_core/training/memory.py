"""The device memory that the state of a training takes: a count, for planning."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from torch import nn

from acwm_core.training.layers import trained_layers
from acwm_core.world_model import WorldModel

FLOAT = 4
"""Bytes of a float32: weights and all that is kept of them, in mixed precision, too."""


class StateMemory(NamedTuple):
    """Bytes on each device; activations, the codec and the allocator's spare come on top.

    Attributes:
        weights: the trained weights.
        gradients: of them.
        optimizer: AdamW's two moments.
        average: the moving average of the weights.
        gathered: of sharded weights, what is whole for a while: those outside of layers and their
            gradient, the layer at work and the one fetched ahead, and a layer's gradient.
    """

    weights: int
    gradients: int
    optimizer: int
    average: int
    gathered: int = 0

    @property
    def total(self) -> int:
        """All together, at their peak."""
        return sum(self)


def state_memory(world_model: WorldModel, sharded_over: int = 1) -> StateMemory:
    """What each device holds; the weights may be on any device, also `meta`.

    Args:
        world_model: what is trained with AdamW.
        sharded_over: devices that share the weights (``trainer.strategy=fsdp``); 1 for all weights
            on each (one device, or ``ddp``).
    """
    trained = [*world_model.model.parameters(), *world_model.conditioner.parameters()]
    part = FLOAT * sum(_largest_part(p, sharded_over) for p in trained)
    state = StateMemory(weights=part, gradients=part, optimizer=2 * part, average=part)
    if sharded_over == 1:
        return state
    layers = [_size(layer.parameters()) for layer in trained_layers(world_model)]
    outside = _size(trained) - sum(layers)
    return state._replace(gathered=FLOAT * (2 * outside + 3 * max(layers, default=0)))


def _largest_part(parameter: nn.Parameter, parts: int) -> int:
    """Numbers in the first, largest part of a parameter that is cut along its first dimension."""
    rows = parameter.shape[0] if parameter.ndim else 1
    return -(-rows // parts) * (parameter.numel() // rows)


def _size(parameters: Iterable[nn.Parameter]) -> int:
    return sum(parameter.numel() for parameter in parameters)
