"""`trainer.strategy=fsdp`: every device keeps a share of the weights, their average and states."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import torch
import torch.distributed.checkpoint as dcp
from lightning.pytorch.core.optimizer import LightningOptimizer
from lightning.pytorch.strategies import ModelParallelStrategy
from torch import Tensor, nn
from torch.distributed.tensor import DTensor, distribute_tensor
from torch.optim import Optimizer

from acwm_core.training.checkpoints import (
    STATES,
    flat,
    named,
    numbered,
    read_details,
    read_whole,
    stored_tensors,
    without_codec,
    write_folder,
)
from acwm_core.training.optimizers import local


class ShardedStrategy(ModelParallelStrategy):
    """Fully sharded data parallel training by PyTorch's `fully_shard` (FSDP2).

    Zhao et al. 2023, arXiv 2304.11277. `WorldModelTask.configure_model` does the sharding;
    checkpoints are folders to which each process writes its share, and are read by any number of
    processes, sharded or not.
    """

    def setup_environment(self) -> None:
        """All devices of all nodes share the weights; none splits single layers."""
        self._data_parallel_size = self.num_nodes * self.num_processes
        self._tensor_parallel_size = 1
        super().setup_environment()

    def lightning_module_state_dict(self) -> dict[str, Any]:
        """The weights, as shares."""
        return self._module.state_dict()

    def optimizer_state(self, optimizer: Optimizer) -> dict[str, Any]:
        """Nothing here: `save_checkpoint` takes it from the optimiser, by name."""
        return {}

    def save_checkpoint(
        self, checkpoint: dict[str, Any], filepath: Any, storage_options: Any = None
    ) -> None:
        """Write a folder, all processes together."""
        write_folder(
            Path(self.broadcast(filepath)),
            checkpoint,
            named(self._optimizer, self._module),
            is_first=self.is_global_zero,
            barrier=self.barrier,
        )

    def load_checkpoint(self, checkpoint_path: Any, weights_only: bool | None = None) -> Any:
        """Read a folder or a file, each process its share; returns all but the tensors."""
        path = Path(self.broadcast(checkpoint_path))
        load = _load_folder if path.is_dir() else _load_file
        return load(path, self._module, self._optimizer)

    @property
    def _module(self) -> nn.Module:
        assert self.model is not None
        return self.model

    @property
    def _optimizer(self) -> Optimizer:
        (optimizer,) = self.optimizers
        return optimizer.optimizer if isinstance(optimizer, LightningOptimizer) else optimizer


def _load_folder(path: Path, module: nn.Module, optimizer: Optimizer) -> dict[str, Any]:
    details = read_details(path)
    weights = without_codec(module.state_dict())
    parameters = dict(module.named_parameters())
    states: dict[str, dict[str, Tensor]] = {}
    for stored, kind in stored_tensors(path).items():
        if stored.startswith(STATES):
            name, _, key = stored.removeprefix(STATES).rpartition(".")
            parameter = parameters[name]
            alike = kind.size == parameter.shape
            empty = torch.zeros_like(parameter.detach()) if alike else torch.zeros(kind.size)
            states.setdefault(name, {})[key] = empty
    cast(Any, dcp).load(flat(weights, states), checkpoint_id=path)  # into the tensors
    optimizer.load_state_dict(numbered(details.pop("optimizer_groups"), states))
    return details


def _load_file(path: Path, module: nn.Module, optimizer: Optimizer) -> dict[str, Any]:
    checkpoint = read_whole(path)
    weights = checkpoint.pop("state_dict")
    with torch.no_grad():
        for name, value in without_codec(module.state_dict()).items():
            local(value).copy_(local(_like(value, weights[name])))
    (saved,) = checkpoint.pop("optimizer_states")
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    for number, values in saved["state"].items():
        parameter = parameters[number]
        for key, value in values.items():
            if value.shape == parameter.shape:
                values[key] = _like(parameter, value)
    optimizer.load_state_dict(saved)
    return checkpoint


def _like(example: Tensor, whole: Tensor) -> Tensor:
    """A whole tensor on the device of `example`, cut as that is."""
    if not isinstance(example, DTensor):
        return whole.to(example.device)
    mesh, placements = example.device_mesh, example.placements
    # Every process has the whole tensor: none needs to send it.
    return distribute_tensor(whole.to(example.device), mesh, placements, src_data_rank=None)
