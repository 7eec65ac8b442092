"""Builds a Lightning Trainer from the recipe's section `trainer`."""

from __future__ import annotations

import copy
import functools
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, cast

import lightning as L
import torch
from jsonargparse import ArgumentError, ArgumentParser
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Callback, ProgressBar
from lightning.pytorch.loggers.logger import Logger
from lightning.pytorch.plugins import CheckpointIO
from lightning.pytorch.strategies import (
    DDPStrategy,
    DeepSpeedStrategy,
    FSDPStrategy,
    ModelParallelStrategy,
)

from acwm_core.errors import RecipeError, TrainingError
from acwm_core.training.config import TrainingConfig, chosen_loggers
from acwm_core.training.precision import automatic_precision, warn_if_emulated
from acwm_core.training.sharding import CheckpointFiles, ShardedStrategy


def build_trainer(
    flags: Mapping[str, Any],
    config: TrainingConfig,
    callbacks: Sequence[Callback],
    loggers: Sequence[Logger],
) -> L.Trainer:
    """Build a Trainer with acwm's defaults, overridden by the recipe's flags.

    Every flag of Lightning's Trainer works, also those that take objects: ``strategy``,
    ``callbacks`` and ``logger`` (added to acwm's own), ``plugins`` and ``profiler`` take
    ``{"class_path": …, "init_args": {…}}``.

    Raises:
        RecipeError: an unknown flag, a value of the wrong type, or a class that cannot be created.
        TrainingError: flags that this training does not support.
    """
    if not isinstance(flags.get("logger"), bool | None):  # names are among `loggers`
        others = [logger for logger in chosen_loggers(flags) if not isinstance(logger, str)]
        flags = {**flags, "logger": others}
    chosen = instantiate_flags(flags)
    _check_saves(chosen)
    _check_flags(chosen, config)
    accelerator = chosen.get("accelerator", "auto")
    if "precision" in chosen:
        warn_if_emulated(chosen["precision"], accelerator)
    accumulated = chosen.get("accumulate_grad_batches", 1)
    ours: dict[str, Any] = {
        "precision": chosen.get("precision") or automatic_precision(accelerator),
        "max_epochs": -1,
        "val_check_interval": config.validate_every_n_steps * accumulated,
        "check_val_every_n_epoch": None,  # validate by steps; the clips have no end
        "num_sanity_val_steps": 0,
        "use_distributed_sampler": False,  # the data module distributes the clips
        "enable_model_summary": False,
        "log_every_n_steps": 10,
    }
    if not isinstance(flags.get("logger"), bool):  # False: no loggers; True: Lightning's default
        chosen["logger"] = [*loggers, *_listed(chosen.get("logger"))]
    added: list[Callback] = _listed(chosen.pop("callbacks", None))
    kept = [callback for callback in callbacks if _wanted(callback, chosen, added)]
    strategy = chosen.get("strategy")
    others = (FSDPStrategy, ModelParallelStrategy, DeepSpeedStrategy)
    if strategy in ("fsdp", "hsdp"):
        chosen["strategy"] = ShardedStrategy(within_nodes=strategy == "hsdp")
    elif isinstance(strategy, others) or str(strategy).startswith(("fsdp", "deepspeed")):
        name = strategy if isinstance(strategy, str) else type(strategy).__name__
        raise TrainingError(
            f"{name} shards the weights in a way that their moving average and checkpoints "
            "do not support: use trainer.strategy=fsdp or hsdp, or ddp if all fits on one device"
        )
    plugins = _listed(chosen.pop("plugins", None))
    if not any(isinstance(plugin, CheckpointIO) for plugin in plugins):
        plugins.append(CheckpointFiles())
    try:
        trainer = L.Trainer(**{**ours, **chosen}, plugins=plugins, callbacks=[*kept, *added])
    except (MisconfigurationException, ValueError, TypeError, RuntimeError) as error:
        raise RecipeError(f"Lightning rejected the trainer flags: {one_line(error)}") from None
    if isinstance(trainer.strategy, DDPStrategy):
        # Without this, each device keeps every gradient twice.
        cast(Any, trainer.strategy)._ddp_kwargs.setdefault("gradient_as_bucket_view", True)
    return trainer


def instantiate_flags(flags: Mapping[str, Any]) -> dict[str, Any]:
    """The given flags, checked and with their objects created.

    Raises:
        RecipeError: an unknown flag, a wrong type, or a class that cannot be imported or created.
    """
    parser = _parser()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            parsed = parser.parse_object({"trainer": copy.deepcopy(dict(flags))})  # it changes them
            instantiated = parser.instantiate(parsed)
    except (ArgumentError, ValueError, TypeError, ImportError) as error:
        raise RecipeError(f"invalid section trainer: {one_line(error)}") from None
    values = cast(dict[str, Any], instantiated["trainer"].as_dict())
    return {name: values[name] for name in flags}


@functools.cache
def _parser() -> Any:
    """Knows the flags of Lightning's Trainer and their types."""
    parser = cast(Any, ArgumentParser(exit_on_error=False))
    parser.add_class_arguments(L.Trainer, "trainer", instantiate=False)
    return parser


def one_line(error: BaseException) -> str:
    """The message of an error in one line.

    Of jsonargparse's lists of reasons, it is the values that would do, or else the first reason.
    """
    message = str(error)
    if about := re.match(r'Parser key "(.+?)":(.*)', message, re.DOTALL):
        key, what = about.groups()
        _, separator, reasons = what.partition("Errors:")
        if separator:
            values = re.findall(r"typing\.Literal\[(.*?)\]", reasons)
            first = reasons.strip().removeprefix("- ").split("\n    - ")[0]
            what = f"expected one of {', '.join(values)}" if values else first
        message = f"{key}: {what}"
    return " ".join(re.sub(r"a <class '(\w+)'>", r"\1", message).split())


def _listed(given: Any) -> list[Any]:
    """The objects of a flag that takes one, several or none."""
    return [*given] if isinstance(given, Sequence) else [given] if given else []


def _wanted(callback: Callback, flags: Mapping[str, Any], added: Sequence[Callback]) -> bool:
    """Whether the flags allow one of acwm's callbacks; Lightning refuses contradictions."""
    if not isinstance(callback, ProgressBar):
        return True
    replaced = any(isinstance(other, ProgressBar) for other in added)
    return flags.get("enable_progress_bar") is not False and not replaced


def _check_saves(flags: Mapping[str, Any]) -> None:
    """Refuse flags with which training would leave nothing, or not what they say."""
    for wrong, message in (
        (
            flags.get("enable_checkpointing") is False or bool(flags.get("barebones")),
            "training that saves no checkpoint leaves no model: omit "
            "trainer.enable_checkpointing and trainer.barebones; "
            "training.checkpoint_every_n_steps=N saves more rarely",
        ),
        (
            flags.get("max_steps") == 0,
            "trainer.max_steps=0 trains nothing: set it to 1 or more",
        ),
        (
            bool(flags.get("overfit_batches")),
            "trainer.overfit_batches does not work with an endless stream of clips: "
            "train on fewer episodes with data.fraction",
        ),
    ):
        if wrong:
            raise TrainingError(message)


def _check_flags(flags: Mapping[str, Any], config: TrainingConfig) -> None:
    has_gpu = torch.cuda.is_available() or torch.backends.mps.is_available()
    is_endless = flags.get("max_steps") in (None, -1)
    for wrong, message in (
        (
            flags.get("accelerator") in ("gpu", "cuda") and not has_gpu,
            "PyTorch finds no GPU here: train on the CPU with "
            "trainer.accelerator=cpu trainer.devices=1, or use +small",
        ),
        (
            flags.get("max_epochs") not in (None, -1),
            "training counts steps, not epochs: set trainer.max_steps=… "
            "instead of trainer.max_epochs",
        ),
        (
            is_endless and flags.get("max_time") is None,
            "the length of the training is missing: set trainer.max_steps=… or "
            "trainer.max_time=DD:HH:MM:SS",
        ),
        (
            is_endless and config.schedule != "constant",
            f"training.schedule={config.schedule} falls to 0 at trainer.max_steps; set "
            "trainer.max_steps=…, or training.schedule=constant",
        ),
        (
            is_endless and config.growing_horizon > 0,
            f"training.growing_horizon={config.growing_horizon} is a share of trainer.max_steps; "
            "set trainer.max_steps=…, or training.growing_horizon=0",
        ),
        (
            str(flags.get("precision")) in ("16-true", "bf16-true"),
            f"trainer.precision={flags.get('precision')} keeps the weights in 16 bits, which "
            "loses small updates; use bf16-mixed",
        ),
    ):
        if wrong:
            raise TrainingError(message)
