"""The layers of a world model: what is recomputed, compiled and sharded one at a time."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from typing import Any, cast

import torch
from torch import nn
from torch.distributed.device_mesh import DeviceMesh
from torch.distributed.fsdp import fully_shard, register_fsdp_forward_method
from torch.utils.checkpoint import checkpoint  # pyright: ignore[reportUnknownVariableType]

from acwm_core.errors import TrainingError
from acwm_core.world_model import WorldModel


def layers_of(module: nn.Module) -> Iterator[nn.Module]:
    """The members of the outermost `nn.ModuleList`s in `module`, where models keep their layers."""
    for child in module.children():
        if isinstance(child, nn.ModuleList):
            yield from child
        else:
            yield from layers_of(child)


def trained_layers(world_model: WorldModel) -> list[nn.Module]:
    """The layers of the model and those that the conditioner adds between them."""
    return [*layers_of(world_model.model), *layers_of(world_model.conditioner)]


def recompute_activations(layers: Sequence[nn.Module]) -> None:
    """Keep only what enters a layer; backward computes what is inside once more.

    The methods are replaced and not the modules, so that all weights keep their names.

    Raises:
        TrainingError: there are no layers.
    """
    if not layers:
        raise TrainingError(
            "training.activation_checkpointing=true recomputes layers, but this model keeps none "
            "in an nn.ModuleList: set it to false"
        )
    for layer in layers:
        layer.forward = functools.partial(checkpoint, layer.forward, use_reentrant=False)


def compile_layers(layers: Sequence[nn.Module]) -> None:
    """Compile each layer by itself, inside of what shards or recomputes it."""
    for layer in layers:
        layer.forward = cast(Any, torch).compile(layer.forward)


def shard(world_model: WorldModel, mesh: DeviceMesh) -> None:
    """Leave on each device its part of the trained weights, in place; the codec stays whole.

    A layer's weights are gathered when it runs and let go right after it; those outside of layers
    once per evaluation. Weights become `DTensor`s, cut along their first dimension. From then on
    all devices must call `loss` and `rollout` together.

    Args:
        world_model: on the CPU or on this process's device, the same on all.
        mesh: of one dimension, the devices that share the weights.
    """
    for layer in trained_layers(world_model):
        fully_shard(layer, mesh=mesh, reshard_after_forward=True)
    codec = set(world_model.codec.parameters())
    fully_shard(world_model, mesh=mesh, reshard_after_forward=True, ignored_params=codec)
    for method in ("loss", "rollout"):
        register_fsdp_forward_method(world_model, method)
