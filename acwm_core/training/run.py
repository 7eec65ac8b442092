"""The model of a run: its weights, and how much training is behind them. Without lightning."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from acwm_core.data.card import DatasetCard
from acwm_core.env.environment import EnvironmentCard
from acwm_core.errors import TrainingError, suggest
from acwm_core.files import check_fetched, parse_json, written_whole
from acwm_core.model.build import build_world_model
from acwm_core.model.shapes import check_finite, float32_by_default
from acwm_core.model.world_model import WorldModel
from acwm_core.recipe import Recipe, compose
from acwm_core.recipe.sections import COMPONENTS
from acwm_core.training.run_folder import RunFolder, find_run, trained_models

FORMAT = 1
"""Version of the metadata of `model.safetensors`."""

TRAINED = ("model.", "conditioner.")
"""Prefixes of a world model's weights that training changes and a run saves."""


class RunBundle(NamedTuple):
    """A loaded run."""

    recipe: Recipe  # what it was trained with
    card: EnvironmentCard  # environment of the dataset it was trained on
    world_model: WorldModel  # with the averaged weights, in evaluation mode, on the CPU


@float32_by_default()
def load_run(path: Path | str) -> RunBundle:
    """Load the model of a run folder, or a trained model by its name or address.

    Raises:
        TrainingError: there is no such run; or the folder holds no run or no readable weights that
            fit its recipe; or they were trained with a different codec than the installed one.
    """
    folder = RunFolder(find_run(path))
    if not folder.path.is_dir():
        near = suggest(str(path), trained_models())
        raise TrainingError(f"there is no run folder and no trained model {path}{near}")
    if not folder.recipe.is_file() or not folder.card.is_file():
        raise TrainingError(f"{folder.path} is not a run: it has no recipe.yaml and card.yaml")
    if not folder.weights.is_file():
        raise TrainingError(
            f"{folder.path} has no trained weights yet: its training stopped before the first "
            "checkpoint"
        )
    folder.check_links()
    recipe = compose(folder.recipe, sections=COMPONENTS)
    card = DatasetCard.read(folder.card).environment
    world_model = build_world_model(recipe, card)
    load_weights(world_model, folder.weights)
    return RunBundle(recipe, card, world_model.requires_grad_(False).eval())


def save_weights(
    path: Path, weights: Mapping[str, Tensor], codec: str | None, step: int, **details: Any
) -> None:
    """Write the trained weights, so that a reader never sees a partial file.

    Args:
        path: the ``.safetensors`` file.
        weights: state dict of a `WorldModel`; only model and conditioner are kept.
        codec: fingerprint of the latents that the weights expect, so that no other is used
            with them. None if it is unknown; then the codec of the recipe is trusted.
        step: number of optimiser steps of the weights.
        **details: further JSON-ready facts for the metadata.
    """
    trained = {name: value for name, value in weights.items() if name.startswith(TRAINED)}
    check_savable(trained)
    kept, seen = dict[str, Tensor](), set[int]()
    for name, value in trained.items():
        whole = value.contiguous().cpu()
        place = whole.untyped_storage().data_ptr()
        kept[name] = whole.clone() if place in seen else whole  # tied weights; each is stored
        seen.add(place)
    facts = {"format": FORMAT, "step": step, "codec": codec, "sha256": digest(kept), **details}
    with written_whole(path) as partial:
        cast(Any, safetensors.torch).save_file(kept, partial, metadata={"acwm": json.dumps(facts)})


def check_savable(state: Mapping[str, Any]) -> None:
    """Check that a state dict can be stored as safetensors, before any training is lost.

    Raises:
        TrainingError: an entry is no plain tensor; names it.
    """
    for name, value in state.items():
        what = type(value).__name__
        if isinstance(value, Tensor):
            if value.layout == torch.strided and not value.is_quantized:
                try:
                    cast(Any, safetensors.torch).save({name: torch.empty(0, dtype=value.dtype)})
                    continue
                except (KeyError, ValueError, TypeError, safetensors.SafetensorError):
                    pass
            what = f"{value.dtype} tensor of layout {value.layout}"
        raise TrainingError(
            f"the weights cannot be saved: {name} is a {what}, a state dict holds plain tensors "
            "(register a tensor as a parameter or a buffer)"
        )


def digest(weights: Mapping[str, Tensor]) -> str:
    """SHA-256 of tensors with their names, types and shapes, without the file's header."""
    sha256 = hashlib.sha256()
    for name, value in sorted(weights.items()):
        sha256.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        sha256.update(cast(Any, value.contiguous().flatten().view(torch.uint8).numpy()))
    return sha256.hexdigest()


def read_metadata(path: Path) -> dict[str, Any]:
    """The metadata that `save_weights` wrote: ``format``, ``step``, ``codec`` and details.

    Raises:
        TrainingError: the file is missing, damaged, or not written by this version of acwm.
    """
    return _read(path)[0]


def _read(path: Path, *, tensors: bool = False) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The metadata of a file and its tensors, of one opening: training may replace it meanwhile."""
    weights: dict[str, Tensor] = {}
    try:
        with cast(Any, safetensors.safe_open)(path, framework="pt") as file:
            metadata: dict[str, str] = file.metadata() or {}
            if tensors:
                weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        facts = parse_json(metadata.get("acwm", "{}"))
    except (OSError, ValueError, safetensors.SafetensorError) as error:
        check_fetched(path)
        raise TrainingError(f"{path} cannot be read as safetensors: {error}") from None
    known = cast(dict[str, Any], facts) if isinstance(facts, dict) else {}
    kinds = {"step": int, "codec": str | None, "sha256": str | None}
    if known.get("format") != FORMAT or not all(
        isinstance(known.get(name), kind) for name, kind in kinds.items()
    ):
        raise TrainingError(f"{path} was not written by this version of acwm")
    return known, weights


def load_weights(world_model: WorldModel, path: Path) -> None:
    """Load weights that `save_weights` wrote.

    Raises:
        TrainingError: the file is damaged, its weights were trained on the latents of another
            codec, or they do not fit the model.
        DataError: its weights are not finite.
    """
    facts, stored = _read(path, tensors=True)
    own = world_model.codec.latents_fingerprint()
    if facts.get("codec") not in (None, own):
        raise TrainingError(
            f"{path} was trained on latents of another codec (fingerprint {facts['codec']}, not "
            f"{own}): restore that codec or train again"
        )
    _check_whole(path, facts, stored)
    weights, expected = _upgraded(world_model, stored), _trained(world_model)
    for name in sorted({*weights, *expected}):
        shape = tuple(weights[name].shape) if name in weights else "missing"
        wanted = tuple(expected[name].shape) if name in expected else "absent"
        if shape != wanted:
            raise TrainingError(
                f"{path} does not fit the recipe: {name} is {shape}, the model expects {wanted}"
            )
    _take(expected, weights)


def load_fitting_weights(world_model: WorldModel, path: Path) -> list[str]:
    """Load those weights that fit by name and shape, of whatever codec's latents.

    Returns:
        The names of the model's other weights, which stay as they are.

    Raises:
        TrainingError: the file is damaged, or not one of its weights fits.
        DataError: its weights are not finite.
    """
    facts, stored = _read(path, tensors=True)
    _check_whole(path, facts, stored)
    weights, expected = _upgraded(world_model, stored), _trained(world_model)
    fitting = {
        name: value
        for name, value in expected.items()
        if name in weights and weights[name].shape == value.shape
    }
    if not fitting:
        raise TrainingError(f"no weight of {path} fits the recipe's model by name and shape")
    _take(fitting, weights)
    return sorted({*expected} - {*fitting})


def _check_whole(path: Path, facts: Mapping[str, Any], weights: Mapping[str, Tensor]) -> None:
    """Check that the weights are finite, and those that the metadata describes."""
    if facts.get("sha256") not in (None, digest(weights)):  # None in old files
        raise TrainingError(
            f"{path} is damaged: its checksum is not the one it was written with; copy it again, "
            "or let training write it again with resume=auto"
        )
    check_finite(path, weights)


def _upgraded(world_model: WorldModel, weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """The weights of a file, those of the model as its present version has them."""
    prefix = "model."
    own = {k.removeprefix(prefix): v for k, v in weights.items() if k.startswith(prefix)}
    others = {k: v for k, v in weights.items() if not k.startswith(prefix)}
    upgraded = world_model.model.upgrade(own)
    return others | {prefix + name: value for name, value in upgraded.items()}


def _trained(world_model: WorldModel) -> dict[str, Tensor]:
    """All but the codec's weights."""
    return {k: v for k, v in world_model.state_dict().items() if k.startswith(TRAINED)}


@torch.no_grad()
def _take(expected: Mapping[str, Tensor], weights: Mapping[str, Tensor]) -> None:
    for name, value in expected.items():
        value.copy_(weights[name])


def training_of(run: RunFolder) -> dict[str, Any]:
    """How much training is behind a run: ``cpu_seconds`` and, if there was one, ``init_from``.

    It is empty for a folder without checkpoints; the weights of a trained model hold it instead.
    """
    from acwm_core.training.checkpoints import read_details  # imports torch.distributed

    if not run.last_checkpoint.exists():
        return {}
    return read_details(run.last_checkpoint).get("callbacks", {}).get("CpuTime", {})


def all_training(name: str, run: RunFolder) -> dict[str, Any]:
    """Sum of all training behind the weights of a run, those it started from included.

    Args:
        name: what the user calls the run; only its last part is kept.

    Returns:
        ``name``, ``step`` and ``cpu_seconds``.
    """
    facts = read_metadata(run.weights) | training_of(run)
    earlier: dict[str, Any] = facts.get("init_from") or {}
    sums = {name: facts.get(name, 0) + earlier.get(name, 0) for name in ("step", "cpu_seconds")}
    return {"name": Path(name).name, **sums}
