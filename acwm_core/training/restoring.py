"""What a checkpoint may restore: numbers where training counts, moments of the weights' shapes, and
no files of others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import torch
from lightning import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from torch.optim import Optimizer


def check_restored(checkpoint: Mapping[str, Any], trainer: Trainer) -> None:
    """Look at what a checkpoint says of Lightning's loops and callbacks, before these take it over.

    A `ModelCheckpoint` removes the files that its state names once there is a better one, wherever
    they are. If they are not in its own folder, as in a run that was moved, or made up to have
    others' files removed, it starts anew.

    Raises:
        ValueError, TypeError, LookupError, AttributeError: it is not as training writes it.
    """
    _check_counters(checkpoint["loops"]["fit_loop"], cast(Any, trainer.fit_loop).state_dict())
    states: dict[str, Any] = checkpoint.get("callbacks", {})
    for callback in trainer.callbacks:
        if isinstance(callback, ModelCheckpoint) and callback.state_key in states:
            fresh: dict[str, Any] = callback.state_dict()
            if not _are_its_own(states[callback.state_key], fresh):
                states[callback.state_key] = fresh


def check_moments(optimizer: Optimizer) -> None:
    """Refuse an optimiser's state unless it lies in memory as its weights do.

    Fused optimisers trust that, and would write beyond its end.

    Raises:
        ValueError, RuntimeError: it has another shape, or is no tensor.
    """
    for weight, state in optimizer.state.items():
        for name, value in state.items():
            if name != "step" and getattr(value, "shape", None) != weight.shape:
                raise ValueError(f"{name} has not the shape {tuple(weight.shape)} of its weight")
            if name != "step" and value.stride() != weight.stride():
                state[name] = torch.empty_like(weight, requires_grad=False).copy_(value)


def _check_counters(found: Any, own: Any) -> None:
    if isinstance(own, Mapping):
        for name in cast(Mapping[str, Any], own).keys() & found.keys():
            _check_counters(found[name], own[name])
    elif not isinstance(found, int) or not 0 <= found < 2**63:
        raise ValueError(f"{str(found)[:80]!r} is no number of steps")


def _are_its_own(state: Mapping[str, Any], fresh: Mapping[str, Any]) -> bool:
    """Whether all files that the state of a `ModelCheckpoint` names lie in its folder."""
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
