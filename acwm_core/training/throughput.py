"""How fast training is: clips and frames per second, and how much of a GPU's arithmetic it uses."""

from __future__ import annotations

import copy
import time
from typing import Any, cast

import torch
from lightning import LightningModule, Trainer
from lightning.fabric.utilities.throughput import get_available_flops
from lightning.pytorch.callbacks import Callback
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from acwm_core.model.world_model import WorldModel
from acwm_core.training.callbacks import is_logged
from acwm_core.training.loggers import SPEED
from acwm_core.training.module import TrainingModule

PRECISIONS = {"bf16-mixed": torch.bfloat16, "16-mixed": torch.float16, "32-true": torch.float32}
"""In what the matrix products of a precision are computed."""


class Throughput(Callback):
    """Tells loggers how fast the steps were since it last did, of all devices together.

    ``speed/clips_per_second`` and ``speed/frames_per_second`` count what the steps trained on;
    ``speed/model_flops_utilisation`` is the arithmetic of `operations` per second, as a share of
    what the devices could do at most. It is left out where Lightning does not know that, as on a
    CPU. The first step and validations are left out; checkpoints and samples are not.

    Args:
        frames: video frames of a whole clip.
        frame_size: their height and width.
    """

    def __init__(self, frames: int, frame_size: tuple[int, int]) -> None:
        self._frames, self._frame_size = frames, frame_size
        self._peak: int | None = None  # operations per second of all devices
        self._operations = 0  # of a whole clip
        self._since: float | None = None
        self._clips = self._seen = 0
        self._validated_at = 0.0

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Count the operations of a clip, while the weights are whole."""
        assert isinstance(pl_module, TrainingModule)
        dtype = PRECISIONS.get(str(trainer.precision))
        one = dtype and get_available_flops(trainer.strategy.root_device, dtype)
        if one:
            self._peak = one * trainer.world_size
            self._operations = operations(pl_module.world_model, self._frames, self._frame_size)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Count the batch; tell where metrics are logged, as only there steps wait for a GPU."""
        assert isinstance(pl_module, TrainingModule)
        clips, frames = pl_module.trained_on
        self._clips += clips * trainer.world_size
        self._seen += clips * frames * trainer.world_size
        if self._since is None or is_logged(trainer):
            self._tell(trainer)
            self._since, self._clips, self._seen = time.perf_counter(), 0, 0

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Stop the clock."""
        self._validated_at = time.perf_counter()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Let the clock go on."""
        if self._since is not None:
            self._since += time.perf_counter() - self._validated_at

    def _tell(self, trainer: Trainer) -> None:
        if self._since is None:
            return
        seconds = time.perf_counter() - self._since
        speeds: dict[str, float] = {
            "clips_per_second": self._clips,
            "frames_per_second": self._seen,
        }
        if self._peak:
            operations = self._operations * self._seen / self._frames
            speeds["model_flops_utilisation"] = operations / self._peak
        for logger in trainer.loggers:
            named = {SPEED + name: value / seconds for name, value in speeds.items()}
            logger.log_metrics(named, step=trainer.global_step - 1)


def operations(world_model: WorldModel, frames: int, frame_size: tuple[int, int]) -> int:
    """Floating-point operations of a clip's loss and gradient; a multiply-add counts as two.

    What activation checkpointing computes again does not count. Nothing is computed: the clip and a
    copy of the weights are on the device `meta`.

    Args:
        world_model: its weights are whole.
        frames: video frames of the clip.
        frame_size: their height and width.
    """
    tensors = [*world_model.parameters(), *world_model.buffers()]
    memo: dict[int, Any] = {id(world_model.codec): world_model.codec}
    for tensor in tensors:
        empty = torch.empty_like(tensor, device="meta")
        is_weight = isinstance(tensor, nn.Parameter)
        memo[id(tensor)] = nn.Parameter(empty, tensor.requires_grad) if is_weight else empty
    counted = copy.deepcopy(world_model, memo)
    codec = world_model.codec
    shape = (1, codec.latent_frames(frames), codec.channels, *codec.latent_size(*frame_size))
    actions = torch.zeros(1, frames, len(world_model.action_low), device="meta")
    with FlopCounterMode(display=False) as counter:
        generators = [torch.Generator().manual_seed(0)]
        loss = counted.loss(torch.zeros(shape, device="meta"), actions, generators)
        cast(Any, loss).backward()
    return counter.get_total_flops()
