"""`fit`: from a recipe to a trained run folder."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Generator
from pathlib import Path
from typing import Any, cast

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.utilities import rank_zero_only
from torch.distributed import DistBackendError

from acwm_core.assembly import build_world_model
from acwm_core.data.atomic import held, written_whole
from acwm_core.data.card import DatasetCard
from acwm_core.data.clips import DataConfig
from acwm_core.data.remote import data_folder
from acwm_core.environment import resolve_size
from acwm_core.errors import AcwmError, TrainingError
from acwm_core.recipe import Recipe
from acwm_core.training.callbacks import (
    LastCheckpoint,
    NanGuard,
    SampleVideos,
    SavedWeights,
    best_checkpoint,
)
from acwm_core.training.checkpoints import last_whole
from acwm_core.training.config import TrainingConfig
from acwm_core.training.data_module import ClipData
from acwm_core.training.loggers import build_loggers
from acwm_core.training.preemption import Preemption, StoppedEarly
from acwm_core.training.progress import StepProgress
from acwm_core.training.quiet import quiet_lightning
from acwm_core.training.resuming import AUTO, check_folder, is_finished, steps_done
from acwm_core.training.run import RunFolder, load_initial
from acwm_core.training.schedule import require_length
from acwm_core.training.task import WorldModelTask
from acwm_core.training.trainer import build_trainer


def fit(recipe: Recipe, run_dir: Path | str, *, resume: Path | str | None = None) -> Path:
    """Train the world model of a recipe.

    With several devices Lightning starts the command of this process once more for each; those
    processes end here, and only the first returns.

    Args:
        recipe: what to train, on what, how long.
        run_dir: the folder to make and fill; it must not hold a run yet.
        resume: a run folder to go on with instead, exactly where its last checkpoint left it; the
            recipe must be the one it was started with, but for `FREE_TO_CHANGE`. Or ``"auto"``: go
            on with `run_dir` if training there has saved anything, else start; nothing happens if
            it is finished.

    Returns:
        The run folder.

    Raises:
        TrainingError: the folder holds a run already; there is nothing to resume, or the recipe is
            another one; the data is of another environment; the loss stopped being finite.
        StoppedEarly: a signal ended it; it can go on.
        AcwmError: whatever is wrong with the recipe's parts, the trainer flags or the data.
    """
    quiet_lightning()
    is_auto = resume == AUTO
    run = RunFolder(Path(run_dir if is_auto or resume is None else resume))
    card = DatasetCard.read(data_folder(recipe.data["path"]))
    _check_environment(recipe, card)
    goes_on = last_whole(run.last_checkpoint) is not None if is_auto else resume is not None
    if _is_first_process():
        check_folder(run, recipe, card, goes_on=goes_on, may_restart=is_auto)
    with _quiet_after_the_first():
        first_step = steps_done(run) if goes_on else 0
        if not (is_auto and is_finished(recipe, first_step)):
            _fit(recipe, card, run, first_step if goes_on else None)
    if not _is_first_process():
        raise SystemExit(0)
    return run.path


def _fit(recipe: Recipe, card: DatasetCard, run: RunFolder, resumed_at: int | None) -> None:
    if resumed_at is not None and is_finished(recipe, resumed_at):
        raise TrainingError(
            f"{run.path} is finished: it did all {resumed_at} steps; to train on, raise "
            "trainer.max_steps"
        )
    task, data = _build(recipe, card, fresh=resumed_at is None)
    trainer = _build_trainer(recipe, run, task, data, resumed_at or 0)
    with _claimed(run, recipe, card):
        checkpoint = None if resumed_at is None else last_whole(run.last_checkpoint)
        _train(trainer, task, data, run, checkpoint)


def _build(recipe: Recipe, card: DatasetCard, *, fresh: bool) -> tuple[WorldModelTask, ClipData]:
    config = TrainingConfig(**recipe.training)
    if config.cpu_threads:
        torch.set_num_threads(config.cpu_threads)
    L.seed_everything(config.seed, verbose=False)
    world_model = build_world_model(recipe, card.environment)
    if config.init_from and fresh:
        load_initial(world_model, Path(config.init_from))
    data = ClipData(DataConfig(**recipe.data), world_model.codec, config.seed)
    return WorldModelTask(world_model, config), data


def _build_trainer(
    recipe: Recipe, run: RunFolder, task: WorldModelTask, data: ClipData, first_step: int
) -> L.Trainer:
    config = task.config
    callbacks: list[Callback] = [
        Preemption(run),
        NanGuard(run),
        SavedWeights(run),
        StepProgress(),
        LastCheckpoint(run.last_checkpoint, config.checkpoint_every_n_steps),
        best_checkpoint(run.checkpoints),
    ]
    if config.sample_every_n_steps:
        video, actions = data.sample(config.sample_videos)
        if len(video):
            every = config.sample_every_n_steps
            callbacks.append(SampleVideos(run, every, video, actions, data.fps))
    trainer = build_trainer(recipe.trainer, config, callbacks, build_loggers(run, first_step))
    require_length(config, trainer.max_steps)
    return trainer


def _train(
    trainer: L.Trainer, task: WorldModelTask, data: ClipData, run: RunFolder, ckpt: Path | None
) -> None:
    on_interrupt = signal.getsignal(signal.SIGINT)
    callbacks: list[Callback] = cast(Any, trainer).callbacks
    (preemption,) = [callback for callback in callbacks if isinstance(callback, Preemption)]
    try:
        with preemption.watching(trainer):
            trainer.fit(task, datamodule=data, ckpt_path=ckpt, weights_only=True)
    except SystemExit:  # how Lightning ends after Ctrl-C, with further ones ignored
        signal.signal(signal.SIGINT, on_interrupt)
        raise TrainingError(f"interrupted; go on with resume={run.path}") from None
    except RuntimeError as error:
        if trainer.world_size == 1 or not _is_of_a_lost_peer(error):
            raise
        raise TrainingError(
            f"another process of this training has ended, for the reason that it gives; go on with "
            f"resume={run.path} when it is mended"
        ) from error


def _is_of_a_lost_peer(error: RuntimeError) -> bool:
    """Whether a collective failed, as it does when a process that takes part in it has ended."""
    return isinstance(error, DistBackendError) or "gloo" in str(error)


def _is_first_process() -> bool:
    return cast(Any, rank_zero_only).rank == 0


@contextlib.contextmanager
def _quiet_after_the_first() -> Generator[None]:
    """One process tells the user what went wrong; the others just end."""
    try:
        yield
    except StoppedEarly:
        if not _is_first_process():
            raise SystemExit(0) from None  # else Lightning kills the first before it can tell
        raise
    except AcwmError as error:
        if not _is_first_process():
            raise SystemExit(error.exit_code) from None
        raise


@contextlib.contextmanager
def _claimed(run: RunFolder, recipe: Recipe, card: DatasetCard) -> Generator[None]:
    """Hold the run folder, with its recipe and card in it, while the first process trains."""
    if not _is_first_process():
        yield
        return
    run.checkpoints.mkdir(parents=True, exist_ok=True)
    with held(run.path):
        with written_whole(run.recipe) as partial:
            partial.write_text(recipe.to_yaml(), encoding="utf-8")
        card.write(run.path)
        yield


def _check_environment(recipe: Recipe, card: DatasetCard) -> None:
    """Data is read, not simulated: refuse a recipe that says something else of it."""
    if recipe.env is None:
        return
    found = card.environment
    if recipe.env.name != found.name:
        raise TrainingError(
            f"{recipe.data['path']} holds episodes of {found.name}, but the recipe says "
            f"env={recipe.env.name}: set env={found.name} or env=null, or another data.path"
        )
    size = recipe.env.params.get("size")
    if size is not None and resolve_size(size, found.frame_size) != found.frame_size:
        height, width = found.frame_size
        raise TrainingError(
            f"{recipe.data['path']} holds frames of {height}×{width}: leave out env.size, or "
            "generate data of that size"
        )
