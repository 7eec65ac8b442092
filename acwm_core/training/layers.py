"""Layers of a world model: recomputing and sharding them one by one, and the memory they take."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence

from torch import nn
from torch.distributed.device_mesh import DeviceMesh
from torch.distributed.fsdp import fully_shard, register_fsdp_forward_method
from torch.utils.checkpoint import checkpoint  # pyright: ignore[reportUnknownVariableType]

from acwm_core.errors import TrainingError
from acwm_core.model.world_model import WorldModel

FLOAT = 4
"""Bytes of a float32, the type of weights and their states, also in mixed precision."""


def layers_of(module: nn.Module) -> Iterator[nn.Module]:
    """The layers of a model: the members of the outermost `nn.ModuleList`s in `module`."""
    for child in module.children():
        if isinstance(child, nn.ModuleList):
            yield from child
        else:
            yield from layers_of(child)


def trained_layers(world_model: WorldModel) -> list[nn.Module]:
    """The layers of the model, and those that the conditioner adds between them."""
    return [*layers_of(world_model.model), *layers_of(world_model.conditioner)]


def recompute_activations(layers: Sequence[nn.Module]) -> None:
    """Keep only the inputs of each layer; the backward pass recomputes its activations.

    The forward methods are replaced, not the modules, so that all weights keep their names.

    Raises:
        TrainingError: there are no layers.
    """
    if not layers:
        raise TrainingError(
            "training.activation_checkpointing=true needs layers in an nn.ModuleList, but this "
            "model has none: set it to false"
        )
    for layer in layers:
        layer.forward = functools.partial(checkpoint, layer.forward, use_reentrant=False)


REPLICAS, SHARDS = "data_parallel", "tensor_parallel"
"""Lightning's names of the two dimensions of a mesh; here clips are spread over both."""


def sharding_mesh(mesh: DeviceMesh) -> DeviceMesh:
    """The mesh of `shard`: one dimension, or two of which the first holds copies of the shards."""
    return mesh[SHARDS] if mesh[REPLICAS].size() == 1 else mesh


def shard(world_model: WorldModel, mesh: DeviceMesh) -> None:
    """Shard the trained weights over the devices, in place; the codec stays whole.

    With two dimensions, the devices along the second share the weights, and the first has copies:
    what is gathered never leaves a node, and only gradients are exchanged between nodes (hybrid
    sharding).

    A layer's weights are gathered when it runs and freed right after; weights outside of layers are
    gathered once per evaluation. Weights become `DTensor`s, cut along their first dimension. From
    then on all devices must call `loss` and `rollout` together.

    Args:
        world_model: on the CPU or on this process's device, with the same weights in all processes.
    """
    for layer in trained_layers(world_model):
        fully_shard(layer, mesh=mesh, reshard_after_forward=True)
    codec = set(world_model.codec.parameters())
    fully_shard(world_model, mesh=mesh, reshard_after_forward=True, ignored_params=codec)
    for method in ("loss", "rollout"):
        register_fsdp_forward_method(world_model, method)


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
