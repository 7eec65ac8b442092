"""The LightningModule that trains a `WorldModel`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import lightning as L
import numpy as np
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, distributed, nn
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from acwm_core.errors import TrainingError, noting
from acwm_core.model.shapes import Actions, Latent, Video
from acwm_core.model.world_model import WorldModel
from acwm_core.training.checkpoints import without_codec
from acwm_core.training.config import TrainingConfig
from acwm_core.training.layers import (
    recompute_activations,
    shard,
    sharding_mesh,
    trained_layers,
)
from acwm_core.training.optimizers import (
    averaged_copy,
    build_optimizer,
    decay_at,
    learning_rate_factor,
    update_average,
)
from acwm_core.training.precision import updates_in_bfloat16
from acwm_core.training.preparation import PreparationClips

TRAIN_NOISE, VALIDATION_NOISE, TRAIN_STARTS = 0, 1, 2
"""Separate random streams, so that validation never repeats the noise of a training step."""

SHORTEST_HORIZON = 4
"""Number of predicted latent frames at the beginning of `training.growing_horizon`, and the minimum
after a random start."""

COMPILED_LENGTHS = 6
"""Lengths of shortened clips that a compiled model sees; PyTorch compiles a function 8 times."""

Batch = Mapping[str, Any]
"""``{"latents": [B, L, C, h, w], "actions": [B, T, A], "positions": [B]}``, where positions are the
clips' places in the stream; or ``"video"``, uint8 `[B, T, 3, H, W]`, instead of the latents; and
``"states"`` `[B, T, S]` if there are some to learn, and ``"weights"`` `[B, T]` of the frames that
actions lead to."""


class TrainingModule(L.LightningModule):
    """Trains the model and conditioner of a world model; its codec stays frozen.

    The randomness of a clip is a pure function of the seed and the clip's place in the stream of
    clips. So a resumed run gives the same result as an uninterrupted one, bit for bit on one
    machine. However many devices and batches share a step, it uses the same clips with the same
    noise. Only dropout and the like, if a plugin has any, depend on the batch.

    Logs ``train/loss``, ``train/learning_rate``, ``train/gradient_norm`` (before clipping) and
    ``val/loss``; the last uses the averaged weights and the same noise every time.

    Attributes:
        averaged: the exponential moving average of `world_model`.
        is_sharded: whether the weights are sharded over the devices, so that all must compute
            together.
        trained_on: clips of the current batch, and how many video frames of each it uses.
        gradient_norm: gradient norm of the current step before clipping; set by `NanGuard`.
    """

    def __init__(
        self, world_model: WorldModel, config: TrainingConfig, *, resumed: bool = False
    ) -> None:
        super().__init__()
        self._resumed = resumed
        self.world_model = world_model
        self.config = config
        self.averaged = averaged_copy(world_model)
        self.is_sharded = False
        self.trained_on = 0, 0
        self.gradient_norm: Tensor | None = None
        self._losses: list[Tensor] = []

    def setup(self, stage: str) -> None:
        """Let the objective prepare the model; the average starts as the prepared weights."""
        world_model, data = self.world_model, cast(Any, self.trainer).datamodule
        clips = PreparationClips(world_model, data, self.config.seed)
        with noting("in preparing the model", *world_model.children()):
            world_model.objective.prepare(world_model.model, clips, resumed=self._resumed)
        self.averaged.to(world_model.device)
        update_average(self.averaged, world_model, 0)

    def configure_model(self) -> None:
        """Set up activation checkpointing, compilation and sharding as the recipe says."""
        layers, compiles = trained_layers(self.world_model), self.config.compile
        mesh = self.device_mesh and sharding_mesh(self.device_mesh)
        # Compiling the whole model is fastest, but impossible if layers are sharded or recomputed.
        by_layers = layers and (mesh is not None or self.config.activation_checkpointing)
        if compiles and by_layers:
            for layer in layers:
                layer.forward = cast(Any, torch).compile(layer.forward)
        elif compiles:
            cast(Any, self.world_model.model).compile()
        if self.config.activation_checkpointing:
            recompute_activations(layers)
        if mesh is not None:
            for world_model in (self.world_model, self.averaged):
                shard(world_model, mesh)
            self.is_sharded = True

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """The loss of one batch."""
        keys = [(self.config.seed, TRAIN_NOISE, position) for position in batch["positions"]]
        cast(Any, torch).manual_seed(seed_of(*keys[0]))
        generators = [generator_of(*key) for key in keys]
        with noting(f"in training step {self.global_step + 1}", *self.world_model.children()):
            latents, actions, states, weights = self._trained_part(batch)
            self.trained_on = len(actions), actions.shape[1]
            loss = self.world_model.loss(latents, actions, generators, states, weights)
        if not loss.requires_grad:
            name = type(self.world_model.model).__name__
            raise TrainingError(
                f"the loss of {name} has no gradient: do not detach tensors in its forward"
            )
        if batch_idx % self.trainer.accumulate_grad_batches == 0:
            self._losses.clear()
        self._losses.append(loss.detach())
        mean = torch.stack(self._losses).mean()  # of the step so far; the logged value is the last
        # For a bar of Lightning's it would read the number, and so wait for an accelerator.
        on_cpu = mean.device.type == "cpu"
        self.log("train/loss", self._of_all_processes(mean), prog_bar=on_cpu)
        rate = self.trainer.optimizers[0].param_groups[0]["lr"]
        self.log("train/learning_rate", torch.tensor(rate))  # Lightning would wait to copy a float
        return loss

    def _of_all_processes(self, value: Tensor) -> Tensor:
        """The mean over the processes; `sync_dist` of Lightning would wait for all of them."""
        if distributed.is_initialized():
            cast(Any, distributed).all_reduce(value)
            value.div_(distributed.get_world_size())
        return value

    def validation_step(self, batch: Batch, batch_idx: int) -> None:
        """Loss of the averaged weights, with noise that depends only on the clip."""
        generators = [generator_of(0, VALIDATION_NOISE, place) for place in batch["positions"]]
        with noting(f"in validation after step {self.global_step}", *self.averaged.children()):
            loss = self.averaged.loss(self.latents(batch), batch["actions"], generators)
        clips = len(batch["actions"])
        self.log("val/loss", loss, prog_bar=True, batch_size=clips, sync_dist=True)

    def rollout(self, given: Video, actions: Actions, **options: Any) -> Video:
        """Predict with the averaged weights; `actions` are raw actions as recorded."""
        with noting(f"in a rollout after step {self.global_step}", *self.averaged.children()):
            return self.averaged.rollout(given, actions, check=False, **options)

    def latents(self, batch: Batch) -> Latent:
        """The latents of a batch, encoded here if it holds video."""
        if "latents" in batch:
            return batch["latents"].to(self.dtype)
        return self.world_model.encode(batch["video"].to(self.dtype) / 255)

    def _trained_part(self, batch: Batch) -> tuple[Latent, Actions, Tensor | None, Tensor | None]:
        """The part of the clips that this step uses: random start, and the current horizon.

        Returns:
            Latents, actions, and the states to learn and weights, if there are some.
        """
        codec, config, latents = self.world_model.codec, self.config, self.latents(batch)
        whole = latents.shape[1]
        shortest = codec.latent_frames(self.world_model.context_frames) + SHORTEST_HORIZON
        spare, start = whole - shortest, 0
        if spare > 0 and config.random_starts:
            random = generator_of(config.seed, TRAIN_STARTS, self.global_step)
            if torch.rand((), generator=random) < config.random_starts:
                start = int(torch.randint(1, spare + 1, (), generator=random))
                spare -= start
        growth = config.growing_horizon * self.trainer.max_steps
        if spare > 0 and self.global_step < growth:
            kept = shortest + int(spare * self.global_step / growth)
        else:
            kept = whole - start
        if config.compile and shortest < kept < whole:
            kept -= (kept - shortest) % -(-(whole - shortest) // COMPILED_LENGTHS)
        first = start * codec.temporal_stride
        rows = slice(first, first + codec.video_frames(kept))
        optional = (batch.get("states"), batch.get("weights"))
        states, weights = (None if values is None else values[:, rows] for values in optional)
        return latents[:, start : start + kept], batch["actions"][:, rows], states, weights

    def configure_optimizers(self) -> OptimizerLRSchedulerConfig:
        """The optimiser and a learning-rate schedule that is updated every step."""
        config, max_steps = self.config, self.trainer.max_steps
        # A gradient scaler must unscale before the norm is measured; fused optimisers do so after.
        fused = self.trainer.precision != "16-mixed"
        bfloat16 = updates_in_bfloat16(self.trainer.precision, self.device)
        optimizer = build_optimizer(self.world_model, config, fused=fused, bfloat16=bfloat16)
        schedule = LambdaLR(optimizer, lambda step: learning_rate_factor(step, config, max_steps))
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def configure_gradient_clipping(
        self,
        optimizer: Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip as the trainer's flags say; Lightning's own method excludes fused optimisers."""
        parameters = [*self.world_model.parameters()]
        if gradient_clip_val and gradient_clip_algorithm == "value":
            nn.utils.clip_grad_value_(parameters, gradient_clip_val)
        elif gradient_clip_val:
            assert self.gradient_norm is not None
            nn.utils.clip_grads_with_norm_(parameters, gradient_clip_val, self.gradient_norm)

    def optimizer_step(
        self,
        epoch: int,
        batch_idx: int,
        optimizer: Optimizer | LightningOptimizer,
        optimizer_closure: Callable[[], Any] | None = None,
    ) -> None:
        """Update the weights, then their average."""
        super().optimizer_step(epoch, batch_idx, optimizer, optimizer_closure)
        decay = decay_at(self.global_step + 1, self.config.ema_decay)
        update_average(self.averaged, self.world_model, decay)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Leave out the frozen codec, which the run's recipe names."""
        checkpoint["state_dict"] = without_codec(checkpoint["state_dict"])

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Set batch counters as if all steps had used the current number of batches per step."""
        steps = checkpoint["global_step"]
        progress = checkpoint["loops"]["fit_loop"]["epoch_loop.batch_progress"]
        before = progress["total"]["ready"]
        now = steps * self.trainer.accumulate_grad_batches
        for counters in (progress["total"], progress["current"]):
            for name in counters:
                counters[name] += now - before

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Load a checkpoint without the codec; everything else must match exactly."""
        own = self.state_dict()
        codec = {name: own[name] for name in own.keys() - without_codec(own).keys()}
        return super().load_state_dict({**codec, **state_dict}, strict=strict, assign=assign)


def seed_of(*key: int) -> int:
    """A 64-bit seed that depends on every number of `key`."""
    return int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0])


def generator_of(*key: int) -> torch.Generator:
    """A CPU generator seeded by `seed_of`."""
    return torch.Generator().manual_seed(seed_of(*key))
