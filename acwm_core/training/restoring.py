"""Checks of what a checkpoint restores: optimiser moments of the right shape, no foreign files."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from torch.optim import Optimizer

from acwm_core.data.atomic import disk_error
from acwm_core.errors import AcwmError, TrainingError, sentence

if TYPE_CHECKING:
    from acwm_core.training.task import WorldModelTask


def keep_own_files(states: dict[str, Any], callbacks: Iterable[Callback]) -> None:
    """Reset the state of each `ModelCheckpoint` that names files outside its own folder.

    It would delete those files once there is a better checkpoint. This happens if a run was moved,
    or if its checkpoint was forged to do so.

    Raises:
        Exception: the states are not in the form that training writes.
    """
    for callback in callbacks:
        if isinstance(callback, ModelCheckpoint) and callback.state_key in states:
            fresh: dict[str, Any] = callback.state_dict()
            if not _are_its_own(states[callback.state_key], fresh):
                states[callback.state_key] = fresh


def _are_its_own(state: Mapping[str, Any], fresh: Mapping[str, Any]) -> bool:
    home, models = fresh["dirpath"], state["best_k_models"]

    def is_inside(path: str) -> bool:  # a plain path below `home`, without `..` or chained schemes
        below = path.removeprefix(f"{home}/")
        return below != path and not {"", ".."} & {*below.split("/")} and "::" not in below

    paths: list[str] = [*models, *filter(None, (state[n] for n in fresh if n.endswith("_path")))]
    return (
        state.get("dirpath") == home
        and all(is_inside(path) for path in paths)
        and all(value.numel() == 1 for value in (state["kth_value"], *models.values()))
        and (state["kth_best_model_path"] in models or not models)
    )


def check_moments(optimizer: Optimizer) -> None:
    """Refuse optimiser states whose shape is not that of their weight.

    A fused optimiser would write beyond their memory.

    Raises:
        ValueError, RuntimeError: a state has another shape, or is no tensor.
    """
    for weight, state in optimizer.state.items():
        for name, value in state.items():
            if name != "step" and getattr(value, "shape", None) != weight.shape:
                raise ValueError(f"{name} has not the shape {tuple(weight.shape)} of its weight")
            if name != "step" and value.stride() != weight.stride():
                state[name] = torch.empty_like(weight, requires_grad=False).copy_(value)


@contextlib.contextmanager
def restored(checkpoint: Path | None, task: WorldModelTask) -> Generator[None]:
    """When resuming, report failures before the end of the first step as errors of the checkpoint.

    Lightning restores what a checkpoint holds without checking types, and fails where it is used.
    """
    try:
        yield
    except Exception as error:
        others = (AcwmError, OSError, MemoryError, torch.OutOfMemoryError)
        if checkpoint is None or task.has_stepped or isinstance(error, others) or disk_error(error):
            raise
        raise TrainingError(
            f"training cannot continue from {checkpoint} ({sentence(error)[:300]}): restore it "
            "from a backup, or start a new training; --traceback shows all of it"
        ) from error
