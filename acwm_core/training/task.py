"""The LightningModule that trains a `WorldModel`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import lightning as L
import numpy as np
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR

from acwm_core.shapes import Latent
from acwm_core.training.averaging import averaged_copy, decay_at, update_average
from acwm_core.training.config import TrainingConfig
from acwm_core.training.schedule import learning_rate_factor, require_length
from acwm_core.world_model import WorldModel

TRAIN_NOISE, VALIDATION_NOISE = 0, 1
"""Streams of randomness, so that validation never repeats the noise of a training step."""

Batch = Mapping[str, Tensor]
"""``{"latents": [B, L, C, h, w], "actions": [B, T, A]}``, or ``"video"``, uint8 `[B, T, 3, H, W]`,
in place of the latents."""


class WorldModelTask(L.LightningModule):
    """Trains the model and conditioner of a world model; its codec stays frozen.

    All randomness of a step is a pure function of seed, batch number and rank, so that a resumed
    run repeats what an uninterrupted one would have done, bit for bit on one machine.

    Logs ``train/loss``, ``train/learning_rate`` and ``val/loss``; the last uses the averaged
    weights and the same noise every time.

    Args:
        world_model: what is trained, in place.
        config: the recipe's section `training`.

    Attributes:
        averaged: the exponential moving average of `world_model`.
    """

    def __init__(self, world_model: WorldModel, config: TrainingConfig) -> None:
        super().__init__()
        self.world_model = world_model
        self.config = config
        self.averaged = averaged_copy(world_model)
        if config.compile:
            cast(Any, self.world_model.model).compile()

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Flow-matching loss of one batch."""
        batches = self.trainer.fit_loop.total_batch_idx
        key = (self.config.seed, TRAIN_NOISE, batches, self.global_rank)
        cast(Any, torch).manual_seed(seed_of(*key))  # dropout and the like, if a plugin has any
        loss = self.world_model.loss(self.latents(batch), batch["actions"], generator_of(*key))
        self.log("train/loss", loss.detach(), prog_bar=True, sync_dist=True)
        self.log("train/learning_rate", self.trainer.optimizers[0].param_groups[0]["lr"])
        return loss

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Loss of the averaged weights under noise that depends on nothing but the batch."""
        generator = generator_of(0, VALIDATION_NOISE, batch_idx)
        loss = self.averaged.loss(self.latents(batch), batch["actions"], generator)
        clips = len(batch["actions"])
        self.log("val/loss", loss, prog_bar=True, batch_size=clips, sync_dist=True)

    def latents(self, batch: Batch) -> Latent:
        """The batch's latents, encoded here if it holds video."""
        if "latents" in batch:
            return batch["latents"].to(self.dtype)
        return self.world_model.encode(batch["video"].to(self.dtype) / 255)

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """AdamW and a learning rate that changes every step."""
        config, max_steps = self.config, self.trainer.max_steps
        require_length(config, max_steps)
        optimizer = AdamW(
            parameter_groups(self.world_model, config.weight_decay),
            lr=config.learning_rate,
            betas=config.betas,
            # Lightning refuses to clip the gradients of fused optimisers under autocast.
            fused=self.trainer.precision == "32-true",
        )
        schedule = LambdaLR(optimizer, lambda step: learning_rate_factor(step, config, max_steps))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def optimizer_step(
        self,
        epoch: int,
        batch_idx: int,
        optimizer: Optimizer | LightningOptimizer,
        optimizer_closure: Callable[[], Any] | None = None,
    ) -> None:
        """One step of the weights, then of their average."""
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        decay = decay_at(self.global_step + 1, self.config.ema_decay)
        update_average(self.averaged, self.world_model, decay)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Leave the frozen codec out: a run's recipe names it."""
        state = checkpoint["state_dict"]
        checkpoint["state_dict"] = {k: v for k, v in state.items() if not _is_codec(k)}

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Load a checkpoint without the codec, strict about all the rest."""
        codec = {k: v for k, v in self.state_dict().items() if _is_codec(k)}
        return super().load_state_dict({**codec, **state_dict}, strict=strict, assign=assign)


def _is_codec(name: str) -> bool:
    return name.split(".")[1] == "codec"


def seed_of(*key: int) -> int:
    """A 64-bit seed that depends on every number of `key`."""
    return int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0])


def generator_of(*key: int) -> torch.Generator:
    """A CPU generator seeded by `seed_of`."""
    return torch.Generator().manual_seed(seed_of(*key))


def parameter_groups(module: nn.Module, weight_decay: float) -> list[dict[str, Any]]:
    """AdamW's groups: weight decay on matrices and kernels, none on vectors and embeddings.

    Norm gains and biases are vectors; lookup tables are matrices that decay would pull to zero row
    by row, the rare ones too.
    """
    tables = {
        id(parameter)
        for part in module.modules()
        if isinstance(part, nn.Embedding)
        for parameter in part.parameters()
    }
    decayed: list[nn.Parameter] = []
    free: list[nn.Parameter] = []
    for parameter in module.parameters():
        if parameter.requires_grad:
            plain = parameter.ndim < 2 or id(parameter) in tables
            (free if plain else decayed).append(parameter)
    groups = [{"params": decayed, "weight_decay": weight_decay}]
    return [*groups, {"params": free, "weight_decay": 0.0}]
