"""`fit`: trains the model of a recipe into a run folder, from the start or resumed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import lightning as L
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_only
from torch.distributed import DistBackendError

from acwm_core.data.atomic import held, written_whole
from acwm_core.data.card import DatasetCard
from acwm_core.data.clips import DataConfig
from acwm_core.data.loader import WORKER_DIED
from acwm_core.data.remote import data_folder
from acwm_core.env.environment import resolve_size
from acwm_core.errors import AcwmError, TrainingError
from acwm_core.model.build import build_world_model
from acwm_core.model.world_model import WorldModel
from acwm_core.recipe import Recipe, recipe_differences
from acwm_core.training.callbacks import (
    LastCheckpoint,
    NanGuard,
    SampleVideos,
    SavedWeights,
    ValidationRollouts,
)
from acwm_core.training.checkpoints import check_sums, last_whole, read_details
from acwm_core.training.config import TrainingConfig, chosen_loggers
from acwm_core.training.data_module import ClipData
from acwm_core.training.effort import CpuTime, all_training
from acwm_core.training.loggers import (
    StepProgress,
    build_loggers,
    classes_of_loggers,
    silence_irrelevant_warnings,
)
from acwm_core.training.preemption import Preemption, StoppedEarly, how_to_resume
from acwm_core.training.restoring import restored
from acwm_core.training.run import RunFolder, load_weights, read_metadata
from acwm_core.training.task import WorldModelTask
from acwm_core.training.threads import found_threads
from acwm_core.training.trained import find_run
from acwm_core.training.trainer import build_trainer
from acwm_core.untrusted import check_folder

AUTO = "auto"
"""Value of `resume`: resume if there is something to resume, else start a new run."""


def fit(recipe: Recipe, run_dir: Path | str, *, resume: Path | str | None = None) -> Path:
    """Train the world model of a recipe.

    With several devices, Lightning runs the command of this process again for each of them. Those
    processes exit at the end of this function; only the first returns.

    Args:
        recipe: what to train, on which data, and how long.
        run_dir: the run folder to create; it must not hold a run yet.
        resume: a run folder to resume instead, exactly at its last checkpoint. The recipe must be
            the one it was started with, except for `FREE_TO_CHANGE`. Or ``"auto"``: resume
            `run_dir` if training has saved a checkpoint there, else start; do nothing if it is
            finished.

    Returns:
        The run folder.

    Raises:
        TrainingError: the folder already holds a run; there is nothing to resume, or the recipe
            differs; the data is of another environment; the loss stopped being finite.
        StoppedEarly: a signal ended training; it can be resumed.
        AcwmError: the recipe's components, the trainer flags or the data are wrong.
    """
    silence_irrelevant_warnings()
    is_auto = resume == AUTO
    run = RunFolder(run_dir if is_auto or resume is None else resume)
    card = DatasetCard.read(data_folder(recipe.data["path"]))
    _check_environment(recipe, card)
    if run.path.is_dir():
        check_folder(run.path)
    last = last_whole(run.last_checkpoint)
    resumes = last is not None if is_auto else resume is not None
    if _is_first_process():
        _check_folder(run, recipe, card, resumes=resumes, may_restart=is_auto)
    with _quiet_after_the_first():
        first_step = _steps_done(run, last) if resumes else 0
        is_finished = 0 < recipe.trainer.get("max_steps", -1) <= first_step
        if is_finished and not is_auto:
            raise TrainingError(
                f"{run.path} is finished after {first_step} steps; to train on, raise "
                "trainer.max_steps"
            )
        if not is_finished:
            _fit(recipe, card, run, last if resumes else None, first_step)
    if not _is_first_process():
        raise SystemExit(0)
    return run.path


def _fit(
    recipe: Recipe, card: DatasetCard, run: RunFolder, checkpoint: Path | None, first_step: int
) -> None:
    config = TrainingConfig(**recipe.training)
    if config.cpu_threads:
        torch.set_num_threads(config.cpu_threads)
    L.seed_everything(config.seed, verbose=False)
    world_model = build_world_model(recipe, card.environment)
    effort = CpuTime()
    if config.init_from and checkpoint is None:
        effort = CpuTime(_start_from(config.init_from, world_model, recipe))
    data = ClipData(DataConfig(**recipe.data), world_model.codec, config.seed)
    task = WorldModelTask(world_model, config)
    preemption = Preemption(run)
    callbacks = [preemption, effort, *_callbacks(run, config, data)]
    chosen = chosen_loggers(recipe.trainer)
    loggers = build_loggers(run, first_step, chosen)
    flags = (
        {**recipe.trainer, "logger": classes_of_loggers(chosen, run)} if chosen else recipe.trainer
    )
    trainer = build_trainer(flags, config, callbacks, loggers)
    threads = config.cpu_threads
    if threads is None and checkpoint is not None:  # that from before, for bitwise equal results
        threads = Recipe.from_yaml(run.recipe).training.get("cpu_threads")
    elif threads is None:
        threads = found_threads(trainer, world_model, data)
    if threads and "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(threads)
    recipe = replace(recipe, training={**recipe.training, "cpu_threads": threads})
    with (
        restored(checkpoint, task),
        _explained(trainer, run, preemption),
        _claimed(run, recipe, card, checkpoint, first_step, task),
        preemption.watching(trainer),
    ):
        for logger in trainer.loggers[len(loggers) :]:
            logger.log_hyperparams(recipe.to_dict())
        trainer.fit(task, datamodule=data, ckpt_path=checkpoint, weights_only=True)


def _start_from(name: str, world_model: WorldModel, recipe: Recipe) -> dict[str, Any]:
    """Load the weights of another run; returns what `all_training` knows of them."""
    initial = RunFolder(find_run(name))
    if not initial.weights.is_file():
        raise TrainingError(f"training.init_from={name}: there is no run with trained weights")
    try:
        load_weights(world_model, initial.weights)
    except TrainingError as error:
        others = recipe_differences(Recipe.from_yaml(initial.recipe), recipe)
        told = [str(error), *(each for each in others if each.startswith("model."))]
        raise TrainingError("; ".join(told)) from error
    return all_training(name, initial)


def _callbacks(run: RunFolder, config: TrainingConfig, data: ClipData) -> list[Callback]:
    callbacks: list[Callback] = [
        NanGuard(run),
        SavedWeights(run),
        StepProgress(),
        LastCheckpoint(run.last_checkpoint, config.checkpoint_every_n_steps),
        ModelCheckpoint(
            run.checkpoints, filename="best", monitor="val/loss", enable_version_counter=False
        ),
    ]
    every, shown = config.sample_every_n_steps, config.sample_videos
    video, actions = data.sample(max(shown if every else 0, config.validation_rollouts))
    if every and len(video):
        fps = data.episodes.card.environment.fps
        callbacks.append(SampleVideos(run, every, video[:shown], actions[:shown], fps))
    if config.validation_rollouts and len(video):
        rollouts = slice(config.validation_rollouts)
        callbacks.append(ValidationRollouts(video[rollouts], actions[rollouts]))
    return callbacks


@contextlib.contextmanager
def _explained(trainer: L.Trainer, run: RunFolder, preemption: Preemption) -> Generator[None]:
    """Turn Ctrl-C, a removed run folder and dead processes into errors that say what to do."""
    try:
        yield
    except SystemExit:  # raised by Lightning after a KeyboardInterrupt
        raise preemption.stopped("interrupted") from None
    except FileNotFoundError as error:
        if run.recipe.exists():
            raise
        raise TrainingError(
            f"{run.path} was removed or moved while it was trained: train it again"
        ) from error
    except RuntimeError as error:
        if "DataLoader worker" in str(error):
            raise TrainingError(WORKER_DIED) from error
        # A collective operation fails if a process that takes part in it has ended.
        is_of_a_lost_peer = isinstance(error, DistBackendError) or "gloo" in str(error)
        if trainer.world_size == 1 or not is_of_a_lost_peer:
            raise
        raise TrainingError(
            "another process of this training failed, see its message; once that is fixed, "
            f"{how_to_resume(run)}"
        ) from error


def _is_first_process() -> bool:
    return cast(Any, rank_zero_only).rank == 0


@contextlib.contextmanager
def _quiet_after_the_first() -> Generator[None]:
    """Let only the first process report an error; the others just exit."""
    try:
        yield
    except AcwmError as error:
        if _is_first_process():
            raise
        # 0 after a signal: otherwise Lightning kills the first process before it can report.
        raise SystemExit(0 if isinstance(error, StoppedEarly) else error.exit_code) from None


@contextlib.contextmanager
def _claimed(
    run: RunFolder,
    recipe: Recipe,
    card: DatasetCard,
    checkpoint: Path | None,
    first_step: int,
    task: WorldModelTask,
) -> Generator[None]:
    """Lock the run folder and write recipe and card into it, while the first process trains.

    If a new run fails before its first step, both are removed, so that it can be fixed and started
    again in the same folder.
    """
    if not _is_first_process():
        yield
        return
    run.checkpoints.mkdir(parents=True, exist_ok=True)
    with held(run.path):
        last = last_whole(run.last_checkpoint)
        if last != checkpoint or (last and read_details(last)["global_step"] != first_step):
            raise TrainingError(
                f"another command has trained {run.path} meanwhile: continue with resume={run.path}"
            )
        with written_whole(run.recipe) as partial:
            partial.write_text(recipe.to_yaml(), encoding="utf-8")
        card.write(run.path)
        try:
            yield
        except Exception as error:
            is_new = checkpoint is None and task.global_step == 0
            if is_new and not isinstance(error, (StoppedEarly, OSError)):
                run.recipe.unlink(missing_ok=True)
                run.card.unlink(missing_ok=True)
            raise


def _check_environment(recipe: Recipe, card: DatasetCard) -> None:
    """Refuse a recipe whose environment or frame size differs from those of the data."""
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


def _check_folder(
    run: RunFolder, recipe: Recipe, card: DatasetCard, *, resumes: bool, may_restart: bool
) -> None:
    """Refuse a folder that holds another run, or a run that this recipe and data cannot resume.

    If `may_restart`, a run that stopped before its first checkpoint may start again.
    """
    if run.weights.exists() and "imported" in read_metadata(run.weights):
        raise TrainingError(
            f"{run.path} holds imported weights and no training to resume: start from them by "
            f"training.init_from={run.path}, and train into another folder"
        )
    if run.recipe.exists():
        with held(run.path):  # fails if another command is training it: its files may be incomplete
            pass
    else:
        if resumes:
            raise TrainingError(f"there is nothing to resume: {run.path} holds no run")
        return
    if not resumes and last_whole(run.last_checkpoint) is not None:
        raise TrainingError(
            f"{run.path} holds a run already: continue it by resume={run.path}, or choose another "
            "folder"
        )
    if not resumes and not may_restart:
        raise TrainingError(
            f"{run.path} holds a run without a checkpoint: if it is not running, remove the "
            "folder; or choose another"
        )
    differences = recipe_differences(Recipe.from_yaml(run.recipe), recipe)
    differences += [f"dataset {d}" for d in DatasetCard.read(run.card).differences(card)]
    if differences:
        raise TrainingError(
            f"{run.path} was started with another recipe: {'; '.join(differences)}; resume with "
            "the old one, or train into a new folder"
        )


def _steps_done(run: RunFolder, checkpoint: Path | None) -> int:
    if checkpoint is None:
        raise TrainingError(
            f"there is nothing to resume: {run.path} stopped before its first checkpoint; remove "
            "the folder and train anew"
        )
    if _is_first_process():
        check_sums(checkpoint)
    return read_details(checkpoint)["global_step"]
