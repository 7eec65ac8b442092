"""What Lightning's Trainer writes checkpoints with: single files, or folders of shards.

With `trainer.strategy=fsdp` each device keeps a shard of weights, average and optimiser states, and
with `hsdp` each device of a node.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO
from lightning.pytorch.core.optimizer import LightningOptimizer
from lightning.pytorch.strategies import ModelParallelStrategy
from torch import nn
from torch.distributed.checkpoint.state_dict import (
    StateDictOptions,
    get_optimizer_state_dict,
    set_model_state_dict,
    set_optimizer_state_dict,
)
from torch.optim import Optimizer

from acwm_core.errors import TrainingError
from acwm_core.training.checkpoints import (
    flat,
    read_details,
    read_shares,
    read_whole,
    without_codec,
    write_file,
    write_folder,
)


class CheckpointFiles(TorchCheckpointIO):
    """Checkpoints of training with all weights on each device: written as one file."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        """Write the file."""
        write_file(Path(path), checkpoint)

    def load_checkpoint(
        self, path: Any, map_location: Any = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a checkpoint of either kind."""
        return read_whole(Path(path))


class ShardedStrategy(ModelParallelStrategy):
    """Fully sharded data parallel training by PyTorch's `fully_shard` (FSDP2).

    Zhao et al. 2023, arXiv 2304.11277. `TrainingModule.configure_model` does the sharding.
    Checkpoints are folders to which each process writes its shard. Any number of processes, sharded
    or not, can read them.

    Args:
        within_nodes: whether each node keeps a copy, sharded over its devices; otherwise there is
            one copy, sharded over all devices of all nodes.
    """

    def __init__(self, *, within_nodes: bool = False) -> None:
        super().__init__()
        self._within_nodes = within_nodes

    def setup_environment(self) -> None:
        """Number the devices by copies of the weights (`REPLICAS`), and by shards (`SHARDS`)."""
        copies = self.num_nodes if self._within_nodes else 1
        self._data_parallel_size = copies
        self._tensor_parallel_size = self.num_nodes * self.num_processes // copies
        super().setup_environment()

    def lightning_module_state_dict(self) -> dict[str, Any]:
        """The weights as shards."""
        return self._module.state_dict()

    def optimizer_state(self, optimizer: Optimizer) -> dict[str, Any]:
        """Empty: `save_checkpoint` takes the state from the optimiser, by parameter name."""
        return {}

    def save_checkpoint(
        self, checkpoint: dict[str, Any], filepath: Any, storage_options: Any = None
    ) -> None:
        """Write a folder; all processes take part."""
        optimizer = get_optimizer_state_dict(self._module, self._optimizer)
        write_folder(Path(self.broadcast(filepath)), checkpoint, optimizer, self)

    def load_checkpoint(self, checkpoint_path: Any, weights_only: bool | None = None) -> Any:
        """Read a folder or a file, each process its shard; returns everything but the tensors."""
        path, module = Path(self.broadcast(checkpoint_path)), self._module
        options = StateDictOptions(full_state_dict=path.is_file(), strict=False)
        own: Any = get_optimizer_state_dict(module, self._optimizer)
        if path.is_dir():
            checkpoint = read_details(path)
            states = own["state"]
            tensors = flat(without_codec(module.state_dict()), states)
            read_shares(path, tensors)
            groups = checkpoint.pop("optimizer_groups")
        else:
            checkpoint = read_whole(path)
            weights = checkpoint.pop("state_dict")
            if missing := without_codec(module.state_dict()).keys() - weights.keys():
                raise TrainingError(f"{path} has no {min(missing)}: it belongs to another model")
            set_model_state_dict(module, weights, options=options)
            (saved,) = checkpoint.pop("optimizer_states")
            names = [name for group in own["param_groups"] for name in group["params"]]
            states = {names[number]: state for number, state in saved["state"].items()}
            groups = [
                {**group, "params": [names[number] for number in group["params"]]}
                for group in saved["param_groups"]
            ]
        state = {"state": states, "param_groups": groups}
        set_optimizer_state_dict(module, self._optimizer, cast(Any, state), options=options)
        return checkpoint

    @property
    def _module(self) -> nn.Module:
        assert self.model is not None
        return self.model

    @property
    def _optimizer(self) -> Optimizer:
        (optimizer,) = self.optimizers
        return optimizer.optimizer if isinstance(optimizer, LightningOptimizer) else optimizer
