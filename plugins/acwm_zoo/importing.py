"""`import_checkpoint`: convert a training checkpoint of another program to a run folder."""

from __future__ import annotations

import contextlib
import hashlib
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import safetensors
import safetensors.torch

from acwm_core.data.card import CARD, DatasetCard, package_versions
from acwm_core.data.remote import data_folder
from acwm_core.env.environment import EnvironmentCard, resolve_size
from acwm_core.errors import AcwmError, DataError, PluginError, TrainingError
from acwm_core.files import load_plain, written_whole
from acwm_core.plugins import catalog
from acwm_core.recipe import Recipe
from acwm_core.recipe.compose import with_overrides
from acwm_core.training.run import save_weights
from acwm_core.training.run_folder import RunFolder
from acwm_zoo.importer import CheckpointImporter, ForeignModel, convert, recipe_of

CODEC = "codec.safetensors"
"""File of the codec's weights in a run folder, if they came with the checkpoint."""


class Imported(NamedTuple):
    """The result of an import."""

    run: Path  # the run folder
    recipe: Recipe  # its recipe
    step: int  # number of optimiser steps of the weights
    parameters: int  # number of parameters of the model and the conditioner
    notes: tuple[str, ...]  # sentences for the user


def import_checkpoint(
    path: Path | str, out: Path | str, overrides: Sequence[str] = (), *, importer: str | None = None
) -> Imported:
    """Create a run folder from a checkpoint that another program trained.

    The codec is not needed for this: the recipe names it, and `load_run` builds it. If the
    checkpoint also holds the codec's weights, they are saved in the run folder, unless overrides
    choose a codec.

    Args:
        path: a file of `torch.save` (pickled code is not executed) or ``.safetensors``.
        out: the run folder to create.
        overrides: changes to the recipe that the checkpoint implies. ``env=NAME`` or
            ``data.path=FOLDER`` is needed to know what the actions mean.
        importer: name of the registered importer; by default the one that knows the format.

    Raises:
        DataError: the file is missing or damaged, holds code or has a format that no importer
            knows, or a tensor is missing, unexpected or of another shape.
        TrainingError: `out` already holds a run.
        RecipeError: an override is wrong.
        DataError: the dataset does not exist, or its actions have another size.
    """
    path, run = Path(path), RunFolder(out)
    if run.recipe.exists():
        raise TrainingError(f"{run.path} holds a run already: choose another folder")
    checkpoint = _read_checkpoint(path, importer)
    notes, implied = checkpoint.notes, list[str]()
    own_codec = bool(checkpoint.codec_weights) and "codec" not in with_overrides({}, overrides)
    if own_codec:
        implied = [f"codec.weights={run.path / CODEC}"]
        notes += (f"The codec's weights came along; they are in {run.path / CODEC}.",)
    recipe = recipe_of(checkpoint, [*implied, *overrides])
    card = _card(recipe, checkpoint.action_size, path)
    weights = convert(checkpoint, recipe)
    run.path.mkdir(parents=True, exist_ok=True)
    if own_codec:
        codec = {name: tensor.contiguous() for name, tensor in checkpoint.codec_weights.items()}
        with written_whole(run.path / CODEC) as partial:
            cast(Any, safetensors.torch).save_file(codec, partial)
    reader = ["--importer", importer] if importer else []
    command = shlex.join(["acwm", "import-checkpoint", str(path), *reader, *overrides])
    save_weights(run.weights, weights, None, checkpoint.step, imported=command)
    card.write(run.path)
    with written_whole(run.recipe) as partial:  # last, because it makes the folder a run
        partial.write_text(recipe.to_yaml(), encoding="utf-8")
    parameters = sum(tensor.numel() for tensor in weights.values())
    return Imported(run.path, recipe, checkpoint.step, parameters, notes)


def _read_checkpoint(path: Path, importer: str | None) -> ForeignModel:
    registry = catalog().registry("importer")
    importers = [registry[importer]] if importer else [*registry]
    readers = [each.create_as(CheckpointImporter) for each in importers]
    content = _content(path)
    models = [model for reader in readers if (model := reader.read(content))]
    if len(models) > 1:
        raise DataError(f"{path} may be one of several formats: say which by --importer")
    if not models:
        names = " or ".join(each.name for each in importers)
        raise DataError(
            f"{path} is not a checkpoint that {names} knows; it holds "
            f"{', '.join(map(str, list(content)[:5])) or 'nothing'}"
        )
    return models[0]


def _content(path: Path) -> Mapping[str, Any]:
    try:
        if path.suffix == ".safetensors":
            return cast(Any, safetensors.torch).load_file(path)
        content = load_plain(path, on_disk=True)
    except (OSError, safetensors.SafetensorError) as error:
        raise DataError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, Mapping):
        raise DataError(f"{path} holds a {type(content).__name__}, no checkpoint")
    return cast(Mapping[str, Any], content)


def _card(recipe: Recipe, action_size: int, checkpoint: Path) -> DatasetCard:
    path, env = recipe.data["path"], recipe.env
    if env is not None and ":" not in path and not (Path(path) / CARD).is_file():
        with checkpoint.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        described = getattr(catalog().component("environment", env.name).load(), "card", None)
        if not isinstance(described, EnvironmentCard):
            raise PluginError(f"environment {env.name!r} has no EnvironmentCard")
        size = resolve_size(env.params.get("size"), described.frame_size)
        card = DatasetCard(
            environment=replace(described, frame_size=size),
            splits={},
            seed=0,
            options={},
            factors={},
            shard_episodes=1,
            versions=package_versions(),
            source={"kind": "checkpoint", "name": checkpoint.name, "sha256": digest},
        )
    else:
        try:
            card = DatasetCard.read(data_folder(path))
        except DataError:
            if env is None and path == "data/mine":
                raise _untold_actions(action_size) from None
            raise
    world = card.environment
    if env and env.name != world.name:
        raise DataError(
            f"{path} holds episodes of {world.name}, not of env={env.name}: leave one of the "
            "overrides out"
        )
    if world.action.size != action_size:
        raise DataError(
            f"the checkpoint takes actions of size {action_size}, and those of {world.name} have "
            f"{world.action.size}"
        )
    return card


def _untold_actions(action_size: int) -> DataError:
    fitting: list[str] = []
    for each in catalog().registry("environment"):
        with contextlib.suppress(AcwmError, ImportError, AttributeError):  # skip failures
            if each.load().card.action.size == action_size:
                fitting.append(f"env={each.name}")
    return DataError(
        f"the checkpoint takes actions of size {action_size} and does not say what they mean: "
        f"add data.path=FOLDER{' or one of ' if fitting else ''}{', '.join(fitting)}"
    )
