"""`fit`: trains the model of a recipe into a run folder, from the start or resumed."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Generator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers.logger import Logger
from torch.distributed import DistBackendError

from acwm_core.data.card import DatasetCard
from acwm_core.data.clips import DataConfig
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.loader import WORKER_DIED
from acwm_core.env.card import EnvironmentCard, meaning_differences
from acwm_core.env.environment import resolve_size
from acwm_core.errors import AcwmError, AcwmWarning, RecipeError, TrainingError
from acwm_core.model.build import build_world_model
from acwm_core.model.dynamics import DynamicsModel
from acwm_core.model.shapes import float32_by_default
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_core.recipe import Recipe, recipe_differences
from acwm_core.training import callbacks
from acwm_core.training.checkpoints import read_step
from acwm_core.training.config import TrainingConfig
from acwm_core.training.data import ClipData
from acwm_core.training.growing import GrowingClipData
from acwm_core.training.loggers import build_loggers, silence_irrelevant_warnings
from acwm_core.training.module import TrainingModule
from acwm_core.training.precision import (
    PRECISION,
    RecordedPrecision,
    with_recorded_precision,
)
from acwm_core.training.progress import StepProgress
from acwm_core.training.resume import (
    AUTO,
    checkpoint_to_resume,
    claimed,
    described,
    is_first_process,
)
from acwm_core.training.run import all_training, load_fitting_weights, load_weights
from acwm_core.training.run_folder import RunFolder, find_run, resume_command
from acwm_core.training.schedule import ResumedSchedule
from acwm_core.training.signals import Preemption, StoppedEarly
from acwm_core.training.threads import use_threads
from acwm_core.training.throughput import Throughput
from acwm_core.training.tracking import begin, tracking
from acwm_core.training.trainer import build_trainer
from acwm_core.training.verdict import first_decides


@float32_by_default()
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
    run = RunFolder(run_dir if resume in (None, AUTO) else resume)
    with _quiet_after_the_first(), contextlib.ExitStack() as claim:
        growing = recipe.data.get("growing", False)
        episodes = EpisodeDataset(recipe.data["path"], "train", growing=growing)
        _check_environment(recipe, episodes.card)
        recipe = _with_states(recipe, episodes)
        with first_decides():
            claim.enter_context(claimed(run))
            checkpoint = checkpoint_to_resume(run, recipe, episodes.card, resume)
        first_step = read_step(checkpoint) if checkpoint else 0
        if not 0 < recipe.trainer.get("max_steps", -1) <= first_step:
            loggers = build_loggers(run, recipe.trainer, first_step)
            with tracking(loggers, run) as continued:
                _train(recipe, episodes, run, checkpoint, loggers, continued)
        elif resume != AUTO:
            raise TrainingError(
                f"{run.path} is finished after {first_step} steps; to train on, raise "
                "trainer.max_steps"
            )
    if not is_first_process():
        raise SystemExit(0)
    return run.path


def _train(
    recipe: Recipe,
    episodes: EpisodeDataset,
    run: RunFolder,
    checkpoint: Path | None,
    loggers: Sequence[Logger],
    continued: Sequence[Logger],
) -> None:
    config = TrainingConfig(**recipe.training)
    L.seed_everything(config.seed, verbose=False)
    world_model = build_world_model(recipe, episodes.card.environment)
    _check_heeded(recipe, world_model)
    start = None
    if config.init_from and checkpoint is None:
        _check_meaning(config, episodes.card.environment)
        start = _start_from(config.init_from, world_model, recipe, config.ignore_mismatched_sizes)
    clips = DataConfig(**recipe.data)
    kind = GrowingClipData if clips.growing else ClipData
    data = kind(clips, episodes, world_model.codec, config.seed)
    module = TrainingModule(world_model, config, resumed=checkpoint is not None)
    before = Recipe.from_yaml(run.recipe) if checkpoint else None
    schedule = ResumedSchedule(before.trainer.get("max_steps", -1) if before else None)
    flags = recipe.trainer
    if before and checkpoint:
        flags = with_recorded_precision(recipe, before, checkpoint).trainer
        if PRECISION in before.trainer:  # an earlier version recorded it nowhere else
            recipe = replace(recipe, trainer=flags)
    trainer = build_trainer(
        flags,
        config,
        [
            preemption := Preemption(run),
            callbacks.CpuTime(start),
            RecordedPrecision(),
            schedule,
            *_callbacks(run, config, data),
        ],
        loggers,
    )
    on_one_cpu = trainer.strategy.root_device.type == "cpu" and trainer.world_size == 1
    known = before.training.get("cpu_threads") if before else None
    threads = use_threads(config.cpu_threads, known, choose=on_one_cpu and not checkpoint)
    recipe = replace(recipe, training={**recipe.training, "cpu_threads": threads})
    with (
        _explained(trainer, run, preemption),
        described(run, recipe, episodes.card, checkpoint is None, module),
        preemption.watching(trainer),
    ):
        for logger in [logger for logger in trainer.loggers if logger not in continued]:
            begin(logger)  # those of the recipe's own classes
            logger.log_hyperparams(recipe.to_dict())
        trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
        _check_saved(run, trainer)


def _check_heeded(recipe: Recipe, world_model: WorldModel) -> None:
    if recipe.data.get("states") and not world_model.objective.learns_states:
        raise RecipeError(
            f"objective={recipe.objective.name} learns no states: leave out data.states, or choose "
            "a model and an objective that do, such as by +scene"
        )
    if recipe.data.get("weights") and not world_model.objective.weighs_frames:
        raise RecipeError(
            f"objective={recipe.objective.name} weighs no frames: leave out data.weights, or "
            "choose an objective that does, such as diffusion_forcing, or a scene with "
            "objective.motion_steps"
        )


def _check_saved(run: RunFolder, trainer: L.Trainer) -> None:
    """Refuse to call a model trained that is nowhere."""
    if trainer.is_global_zero and not run.weights.exists():
        raise TrainingError(
            f"nothing was trained, as the flags allowed {trainer.global_step} steps: set "
            "trainer.max_steps, max_time and limit_train_batches so that there is one"
        )


def _check_meaning(config: TrainingConfig, card: EnvironmentCard) -> None:
    """Refuse to start from weights of other actions, unless any may be taken; report bounds."""
    name = str(config.init_from)
    initial = RunFolder(find_run(name))
    if not initial.card.is_file():
        return
    before = DatasetCard.read(initial.card).environment
    ours, theirs = meaning_differences(card, before)
    message = ""
    if ours:
        message = (
            f"the data has {', '.join(ours)}, but {name} was trained with {', '.join(theirs)}, so "
            "its weights mean something else"
        )
        if not config.ignore_mismatched_sizes:
            anyway = "training.ignore_mismatched_sizes=true starts from them anyway"
            raise TrainingError(f"{message}: {anyway}")
    elif (card.action.low, card.action.high) != (before.action.low, before.action.high):
        message = (
            f"the bounds of the actions differ from those of {name}, so at first "
            "the model misjudges their size"
        )
    if message and is_first_process():
        warnings.warn(message, AcwmWarning, stacklevel=2)


def _with_states(recipe: Recipe, episodes: EpisodeDataset) -> Recipe:
    """The recipe with the fields of the state that its model learns if it names none."""
    model = catalog().component("model", recipe.model.name).load()
    choose = getattr(model, "default_states", DynamicsModel.default_states)
    if recipe.data.get("states") or choose.__func__ is DynamicsModel.default_states.__func__:
        return recipe
    card = episodes.card.environment
    names = [field.name for field in card.state]
    changing = [name for name in names if np.ptp(episodes.states(0, [name]), 0).any()]
    chosen = choose(card, changing, **recipe.model.params)
    return replace(recipe, data={**recipe.data, "states": [*chosen]})


def _start_from(
    name: str, world_model: WorldModel, recipe: Recipe, ignore_mismatched: bool
) -> dict[str, Any]:
    """Load the weights of another run; returns what `all_training` knows of them."""
    initial = RunFolder(find_run(name))
    if not initial.weights.is_file():
        raise TrainingError(f"training.init_from={name}: there is no run with trained weights")
    if ignore_mismatched:
        others = load_fitting_weights(world_model, initial.weights)
        if others:
            message = f"initialised randomly, because {name} has none that fit: {', '.join(others)}"
            warnings.warn(message, AcwmWarning, stacklevel=2)
        return all_training(name, initial)
    try:
        load_weights(world_model, initial.weights)
    except TrainingError as error:
        others = recipe_differences(Recipe.from_yaml(initial.recipe), recipe)
        of_the_model = [difference for difference in others if difference.startswith("model.")]
        parts = ("model", "codec", "conditioner")
        anyway = ["training.ignore_mismatched_sizes=true takes what fits"]
        anyway = anyway if any(difference.startswith(parts) for difference in others) else []
        raise TrainingError("; ".join([str(error), *of_the_model, *anyway])) from error
    return all_training(name, initial)


def _callbacks(run: RunFolder, config: TrainingConfig, data: ClipData) -> list[Callback]:
    chosen: list[Callback] = [
        callbacks.NanGuard(run),
        callbacks.SavedWeights(run),
        StepProgress(),
        callbacks.LastCheckpoint(run.last_checkpoint, config.checkpoint_every_n_steps),
        callbacks.BestCheckpoint(run.checkpoints),
        Throughput(data.frames, data.episodes.card.environment.frame_size),
    ]
    every, count = config.sample_every_n_steps, config.sample_videos
    rollouts = config.validation_rollouts
    video, actions = data.sample(max(count if every else 0, rollouts))
    if every and len(video):
        fps = data.episodes.card.environment.fps
        chosen.append(callbacks.SampleVideos(run, every, video[:count], actions[:count], fps))
    if rollouts and len(video):
        chosen.append(callbacks.ValidationRollouts(video[:rollouts], actions[:rollouts]))
    return chosen


def _check_environment(recipe: Recipe, card: DatasetCard) -> None:
    """Refuse a recipe whose environment or frame size differs from those of the data."""
    if recipe.env is None:
        return
    own = card.environment
    if recipe.env.name != own.name:
        raise TrainingError(
            f"{recipe.data['path']} holds episodes of {own.name}, but the recipe says "
            f"env={recipe.env.name}: set env={own.name} or env=null, or another data.path"
        )
    size = recipe.env.params.get("size")
    if size is not None and resolve_size(size, own.frame_size) != own.frame_size:
        height, width = own.frame_size
        raise TrainingError(
            f"{recipe.data['path']} holds frames of {height}×{width}: leave out env.size, or "
            "generate data of that size"
        )


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
            f"{run.path} was removed or moved during training: train it again"
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
            f"continue with `{resume_command(run)}`"
        ) from error


@contextlib.contextmanager
def _quiet_after_the_first() -> Generator[None]:
    """Let only the first process report an error; the others just exit."""
    try:
        yield
    except AcwmError as error:
        if is_first_process():
            raise
        # 0 after a signal: otherwise Lightning kills the first process before it can report.
        raise SystemExit(0 if isinstance(error, StoppedEarly) else error.exit_code) from None
