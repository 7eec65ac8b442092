"""Callbacks of training: finite numbers, checkpoints, saved weights, CPU time, videos, rollouts."""

from __future__ import annotations

import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback, Checkpoint, ModelCheckpoint
from torch import Tensor
from torch.distributed.tensor import DTensor
from torch.optim import Optimizer
from torchmetrics.image import PeakSignalNoiseRatio, StructuralSimilarityIndexMeasure

from acwm_core.errors import TrainingError
from acwm_core.files import written_whole
from acwm_core.training.checkpoints import without_codec
from acwm_core.training.module import TrainingModule
from acwm_core.training.optimizers import gradient_norm, total_norm
from acwm_core.training.pictures import draw_strip, encode_gif, show_gif, show_picture
from acwm_core.training.run import check_savable, save_weights
from acwm_core.training.run_folder import RunFolder

MAX_ROLLOUT_STEPS = 4
"""Most sampling steps in validation rollouts, which only show a trend and must be cheap."""

MAX_PSNR = 80.0
"""PSNR in dB of equal clips, as in evaluation; otherwise it would be infinite."""


STRIP = "validation: truth above prediction"


class NanGuard(Callback):
    """Stops training before a loss or gradient that is not finite reaches the weights.

    Steps do not wait for an accelerator. There, it looks at the gradients of the last steps when
    metrics are logged, and before anything is validated or saved.

    It also stops if a validation result, the weights or their average are not finite, before they
    are saved. The average must be checked itself, since it has no gradient.

    Logs ``train/gradient_norm``, the norm before clipping.
    """

    def __init__(self, run: RunFolder) -> None:
        self._run = run
        self._norms = dict[int, Tensor]()  # of steps that were not looked at yet

    def on_before_optimizer_step(
        self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer
    ) -> None:
        """Check the gradient; all ranks see the same value and stop together."""
        assert isinstance(pl_module, TrainingModule)
        norm = gradient_norm(pl_module.world_model.parameters())
        pl_module.gradient_norm = norm
        pl_module.log("train/gradient_norm", norm)
        if trainer.scaler is None:
            self._norms[trainer.global_step] = norm
            if norm.device.type == "cpu":
                self._look(trainer)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Check the loss if there is a gradient scaler (16-mixed): only gradients may overflow."""
        if trainer.scaler is not None and not torch.isfinite(outputs["loss"]):
            self._stop(trainer, "the loss or its gradient is")
        if self._norms and is_logged(trainer):
            self._look(trainer)

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Check the gradients of the steps before."""
        self._look(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Check the validation results; all ranks have the same."""
        for name in ("val/loss", "val/psnr"):
            if not trainer.callback_metrics.get(name, torch.zeros(())).isfinite():
                self._stop(trainer, f"{name} is")

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Check the weights and their average before they are written."""
        self._look(trainer)
        if not _are_finite(checkpoint["state_dict"].values()):
            self._stop(trainer, "the weights or their average are")

    def _look(self, trainer: Trainer) -> None:
        """Stop at the first step whose gradient was not finite."""
        norms, self._norms = self._norms, {}
        if norms:
            finite: list[bool] = cast(Any, torch.stack([*norms.values()]).isfinite()).tolist()
            for step, is_finite in zip(norms, finite, strict=True):
                if not is_finite:
                    self._stop(trainer, "the loss or its gradient is", step)

    def _stop(self, trainer: Trainer, what: str, step: int | None = None) -> None:
        last = self._run.last_checkpoint
        kept = f"{last} is the last good checkpoint" if last.exists() else "nothing was saved yet"
        raise TrainingError(
            f"{what} not finite in step {trainer.global_step if step is None else step} ({kept}); "
            "lower training.learning_rate or trainer.gradient_clip_val, or use "
            "trainer.precision=32-true"
        )


def _are_finite(tensors: Iterable[Tensor]) -> bool:
    """Whether all tensors are finite, on all devices."""
    floating = [tensor for tensor in tensors if tensor.is_floating_point()]
    sharded = [tensor for tensor in floating if isinstance(tensor, DTensor)]
    whole = [tensor for tensor in floating if not isinstance(tensor, DTensor)]
    # Compute both norms before answering, as all ranks must compute them together.
    norms = [total_norm(gradients) for gradients in (sharded, whole) if gradients]
    return all(bool(norm.isfinite()) for norm in norms)


class SavedWeights(Callback):
    """Writes the averaged weights to `model.safetensors` whenever a checkpoint is saved."""

    def __init__(self, run: RunFolder) -> None:
        self._run = run
        self._codec: str | None = None

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Refuse weights that cannot be saved, before steps are lost."""
        assert isinstance(pl_module, TrainingModule)
        check_savable(without_codec(pl_module.state_dict()))

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        """Take the weights from the checkpoint; sharded ones are gathered here."""
        assert isinstance(pl_module, TrainingModule)
        weights: dict[str, Tensor] = {}
        for name, value in checkpoint["state_dict"].items():
            if name.startswith("averaged."):
                whole = value.full_tensor() if isinstance(value, DTensor) else value
                if trainer.is_global_zero:
                    weights[name.removeprefix("averaged.")] = whole.cpu()
        if trainer.is_global_zero:
            # The codec is frozen, and hashing a large one takes longer than writing the file.
            self._codec = self._codec or pl_module.world_model.codec.latents_fingerprint()
            save_weights(self._run.weights, weights, self._codec, step=checkpoint["global_step"])


class CpuTime(Callback):
    """Stores in checkpoints the CPU time of training in seconds, summed over all resumes.

    It is not stored with weights and metrics, which are equal when training is repeated.

    Args:
        init_from: `all_training` of the run whose weights training started from, which is stored
            as well, since that run may be gone or another by the time somebody asks.
    """

    def __init__(self, init_from: dict[str, Any] | None = None) -> None:
        self._before = -time.process_time()
        self._init_from = init_from

    def state_dict(self) -> dict[str, Any]:
        """The CPU time so far, and what training started from."""
        start = {"init_from": self._init_from} if self._init_from else {}
        return {"cpu_seconds": self._before + time.process_time(), **start}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Add the CPU time stored in a checkpoint."""
        self._before += state_dict["cpu_seconds"]
        self._init_from = state_dict.get("init_from")


class SampleVideos(Callback):
    """Writes predicted videos beside the truth to `samples/` and to loggers, as GIFs.

    Args:
        run: the run folder.
        every_n_steps: optimiser steps between samples.
        video: true clips `[B, T, 3, H, W]`, uint8.
        actions: their actions `[B, T, A]`.
        fps: frames per second of the clips.
    """

    def __init__(
        self, run: RunFolder, every_n_steps: int, video: Tensor, actions: Tensor, fps: float
    ) -> None:
        self._run, self._every_n_steps, self._fps = run, every_n_steps, fps
        self._video, self._actions = video, actions

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Sample from the averaged weights when it is time."""
        assert isinstance(pl_module, TrainingModule)
        due = stepped(trainer, batch_idx) and trainer.global_step % self._every_n_steps == 0
        if due and (trainer.is_global_zero or pl_module.is_sharded):
            truth = self._video.to(pl_module.device) / 255
            actions = self._actions.to(pl_module.device)
            given = truth[:, : pl_module.averaged.context_frames]
            predicted = pl_module.rollout(given, actions)
            if trainer.is_global_zero:
                self._show(trainer, encode_gif(truth, predicted, self._fps))

    def _show(self, trainer: Trainer, gif: bytes) -> None:
        self._run.samples.mkdir(exist_ok=True)
        path = self._run.samples / f"step-{trainer.global_step:07d}.gif"
        with written_whole(path) as partial:
            partial.write_bytes(gif)
        for logger in trainer.loggers:
            show_gif(logger, "samples: truth | prediction", path, trainer.global_step)


class ValidationRollouts(Callback):
    """Logs the similarity of short rollouts of the averaged weights to the true clips.

    ``val/psnr`` is in dB, from the mean error of all pixels. ``val/ssim`` is from torchmetrics,
    which ignores the border of frames, with a uniform 7×7 window. ``val/psnr_over_first_frame`` is
    the PSNR minus that of repeating the first frame (the last context frame, if there are several).
    A clip has the same noise every time, however many devices share the clips. Loggers show a
    strip of frames of the first clips.

    Args:
        video: true clips `[B, T, 3, H, W]`, uint8.
        actions: their actions `[B, T, A]`.
    """

    def __init__(self, video: Tensor, actions: Tensor) -> None:
        self._video, self._actions = video, actions
        self._psnr, self._still = (PeakSignalNoiseRatio(data_range=1.0) for _ in range(2))
        self._ssim = StructuralSimilarityIndexMeasure(
            gaussian_kernel=False, kernel_size=7, data_range=1.0
        )

    def on_validation_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Predict this process's share of the clips, and log the result of all processes."""
        assert isinstance(pl_module, TrainingModule)
        own = range(trainer.global_rank, len(self._video), trainer.world_size)
        # Sharded weights are gathered layer by layer, so all processes must predict together.
        rows = [*(range(len(self._video)) if pl_module.is_sharded else own)]
        metrics: list[Any] = [self._psnr, self._still, self._ssim]
        for metric in metrics:
            metric.to(pl_module.device).reset()
        if rows:
            truth = self._video[rows].to(pl_module.device) / 255
            actions = self._actions[rows].to(pl_module.device)
            steps = min(pl_module.averaged.objective.steps or 1, MAX_ROLLOUT_STEPS)
            model = pl_module.averaged
            known = model.context_frames
            given = truth[:, :known]
            predicted = pl_module.rollout(given, actions, steps=steps, seeds=rows)
            if trainer.is_global_zero:
                strip = draw_strip(truth, predicted)
                for logger in trainer.loggers:
                    show_picture(logger, STRIP, strip, trainer.global_step)
            clips = (video[:, known - 1 :] for video in (truth, predicted.to(truth)))
            for place, true, video in zip(rows, *clips, strict=True):
                if place in own:
                    self._psnr.update(video, true)
                    self._still.update(true[:1].expand_as(true), true)
                    self._ssim.update(video, true)
        psnr, still, ssim = (metric.compute() for metric in metrics)
        psnr, still = psnr.clamp(max=MAX_PSNR), still.clamp(max=MAX_PSNR)
        pl_module.log("val/psnr", psnr, prog_bar=True, sync_dist=True)
        pl_module.log("val/ssim", ssim, sync_dist=True)
        pl_module.log("val/psnr_over_first_frame", psnr - still, sync_dist=True)


class BestCheckpoint(ModelCheckpoint):
    """`best.ckpt`, the checkpoint with the least validation loss."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, "best", monitor="val/loss", enable_version_counter=False)

    @property
    def state_key(self) -> str:
        """That of `ModelCheckpoint`, under which runs have always stored it."""
        return super().state_key.replace(type(self).__name__, ModelCheckpoint.__name__)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take the least loss from a checkpoint, but no path: the folder may have moved."""
        score, path = state_dict["best_model_score"], f"{self.dirpath}/best.ckpt"
        if score is not None:
            self.best_model_score = self.kth_value = score
            self.best_model_path = self.kth_best_model_path = path
            self.best_k_models = {path: score}


class LastCheckpoint(Checkpoint):
    """Saves `last.ckpt`, from which a run resumes, every few steps and after the last one.

    Lightning's `ModelCheckpoint` saves before the validation of the same step, which a resumed run
    then leaves out, and not after the last step. This always saves in the middle of Lightning's
    epoch, so that a finished run can be trained further.
    """

    def __init__(self, path: Path, every_n_steps: int) -> None:
        self._path, self._every_n_steps = path, every_n_steps
        self._is_due = self._stops = False

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Save when it is time, but not before the validation of this step, if there is one."""
        step = trainer.global_step
        if not stepped(trainer, batch_idx):
            # A run can only resume exactly between steps, so finish the step before stopping.
            self._stops, trainer.should_stop = self._stops or trainer.should_stop, False
            return
        trainer.should_stop = trainer.should_stop or self._stops
        is_last = step == trainer.max_steps or trainer.should_stop
        if is_last or step % self._every_n_steps == 0:
            self._is_due = True
            if not validates_after_this_batch(trainer):
                self._save(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save if this was postponed: Lightning does not repeat the validation of a saved step."""
        self._save(trainer)

    def _save(self, trainer: Trainer) -> None:
        if self._is_due:
            self._is_due = False
            trainer.save_checkpoint(self._path)


def stepped(trainer: Trainer, batch_idx: int) -> bool:
    """Whether the batch that just ended was the last one of an optimiser step."""
    return (batch_idx + 1) % trainer.accumulate_grad_batches == 0


def is_logged(trainer: Trainer) -> bool:
    """Whether the metrics of the step that just ended are logged: steps may wait for them."""
    interval: int = cast(Any, trainer).log_every_n_steps
    return interval > 0 and trainer.global_step % interval == 0


def validates_after_this_batch(trainer: Trainer) -> bool:
    """Whether a validation that is scheduled by batches follows the batch that just ended."""
    interval = trainer.val_check_batch
    if not isinstance(interval, int) or trainer.check_val_every_n_epoch is not None:
        return False
    if not trainer.enable_validation or not any(cast(list[int], trainer.num_val_batches)):
        return False
    return (trainer.fit_loop.total_batch_idx + 1) % interval == 0
