"""What a checkpoint may restore: moments of the weights' shapes, and no files of others."""

from __future__ import annotations

import contextlib
from collections.abc import Generator, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from torch.optim import Optimizer

from acwm_core.data.atomic import disk_error
from acwm_core.errors import AcwmError, TrainingError
from acwm_core.errors.plugin_code import explained

if TYPE_CHECKING:
    from acwm_core.training.task import WorldModelTask


def keep_own_files(states: dict[str, Any], callbacks: Iterable[Callback]) -> None:
    """Have each `ModelCheckpoint` whose state names files outside its own folder start anew.

    It removes them once there is a better one: in a run that was moved, or made up for that.

    Raises:
        Exception: they are not as training writes them.
    """
    for callback in callbacks:
        if isinstance(callback, ModelCheckpoint) and callback.state_key in states:
            fresh: dict[str, Any] = callback.state_dict()
            if not _are_its_own(states[callback.state_key], fresh):
                states[callback.state_key] = fresh


def _are_its_own(state: Mapping[str, Any], fresh: Mapping[str, Any]) -> bool:
    home, models = fresh["dirpath"], state["best_k_models"]

    def is_inside(path: str) -> bool:  # also one with a scheme is just a path in `home`
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
    """Refuse an optimiser's state of other shapes than its weights': a fused one writes beyond it.

    Raises:
        ValueError, RuntimeError: it has another shape, or is no tensor.
    """
    for weight, state in optimizer.state.items():
        for name, value in state.items():
            if name != "step" and getattr(value, "shape", None) != weight.shape:
                raise ValueError(f"{name} has not the shape {tuple(weight.shape)} of its weight")
            if name != "step" and value.stride() != weight.stride():
                state[name] = torch.empty_like(weight, requires_grad=False).copy_(value)


@contextlib.contextmanager
def restored(checkpoint: Path | None, task: WorldModelTask) -> Generator[None]:
    """Tell what fails up to the end of the first step as an error of the checkpoint, if any.

    Lightning takes over what one holds, of whatever type, and fails where it is used.
    """
    try:
        yield
    except Exception as error:
        others = (AcwmError, OSError, MemoryError, torch.OutOfMemoryError)
        if checkpoint is None or task.has_stepped or isinstance(error, others) or disk_error(error):
            raise
        raise TrainingError(
            f"training cannot go on from {checkpoint} ({explained(error)[:300]}): put a copy of it "
            "in its place, or train anew; --traceback shows all of it"
        ) from error
