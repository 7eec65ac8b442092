"""`import_checkpoint`: from a training checkpoint of another program to a run folder."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

import safetensors
import safetensors.torch
import torch

from acwm_core.assembly import build_conditioner, build_model
from acwm_core.catalog import catalog
from acwm_core.data.atomic import written_whole
from acwm_core.data.card import CARD, DatasetCard, package_versions
from acwm_core.data.remote import data_folder
from acwm_core.environment import EnvironmentCard, resolve_size
from acwm_core.errors import AcwmError, CheckpointError, DataError, PluginError, TrainingError
from acwm_core.flow import Flow
from acwm_core.importer import CheckpointImporter, ForeignModel, State
from acwm_core.plain_pickle import load_plain
from acwm_core.recipe import ComponentConfig, Recipe
from acwm_core.recipe.compose import with_overrides
from acwm_core.training.run import RunFolder, save_weights

CODEC = "codec.safetensors"
"""The codec's weights in a run folder, where they came with the checkpoint."""


class Imported(NamedTuple):
    """What an import made.

    Attributes:
        run: the run folder.
        recipe: its recipe.
        step: optimiser steps behind the weights.
        parameters: how many the model and the conditioner have.
        notes: sentences for people.
    """

    run: Path
    recipe: Recipe
    step: int
    parameters: int
    notes: tuple[str, ...]


def import_checkpoint(
    path: Path | str, out: Path | str, overrides: Sequence[str] = (), *, importer: str | None = None
) -> Imported:
    """Make a run folder of a checkpoint that another program trained.

    The codec is not needed for it: the recipe names it, and `load_run` builds it. If the checkpoint
    holds its weights too, they are laid into the run folder, unless overrides choose a codec.

    Args:
        path: a file of `torch.save`, in which nothing is executed, or ``.safetensors``.
        out: the run folder to make.
        overrides: change the recipe that the checkpoint implies. ``env=NAME`` or
            ``data.path=FOLDER``
            is needed, to know what the actions mean.
        importer: the registered importer that reads it; by default the one that knows the format.

    Raises:
        CheckpointError: the file is missing or damaged, holds code or what no importer knows; a
            tensor is missing, unexpected or of another shape.
        TrainingError: `out` holds a run already.
        RecipeError: an override is wrong.
        DataError: the dataset is not there, or its actions are of another size.
    """
    path, run = Path(path), RunFolder(Path(out))
    if run.recipe.exists():
        raise TrainingError(f"{run.path} holds a run already: choose another folder")
    found = read_checkpoint(path, importer)
    own_codec = bool(found.codec_weights) and "codec" not in with_overrides({}, overrides)
    recipe = recipe_of(
        found, [f"codec.weights={run.path / CODEC}", *overrides] if own_codec else overrides
    )
    card = _card(recipe, found.action_size, path)
    weights = convert(found, recipe)
    run.path.mkdir(parents=True, exist_ok=True)
    if own_codec:
        with written_whole(run.path / CODEC) as partial:
            cast(Any, safetensors.torch).save_file(
                {name: tensor.contiguous() for name, tensor in found.codec_weights.items()}, partial
            )
    reader = ["--importer", importer] if importer else []
    command = shlex.join(["acwm", "import-checkpoint", str(path), *reader, *overrides])
    save_weights(run.weights, weights, None, found.step, imported=command)
    card.write(run.path)
    run.recipe.write_text(recipe.to_yaml(), encoding="utf-8")  # last: it makes the folder a run
    parameters = sum(tensor.numel() for tensor in weights.values())
    notes = found.notes
    if own_codec:
        notes += (f"The codec's weights came along; they are in {run.path / CODEC}.",)
    return Imported(run.path, recipe, found.step, parameters, notes)


def read_checkpoint(path: Path, importer: str | None = None) -> ForeignModel:
    """What a checkpoint file holds.

    Raises:
        CheckpointError: see `import_checkpoint`.
        UnknownNameError: there is no such importer.
    """
    names = [importer] if importer else [part.name for part in catalog().registry("importer")]
    importers = [_importer(name) for name in names]
    content = _content(path)
    found = [model for each in importers if (model := each.read(content))]
    if len(found) > 1:
        raise CheckpointError(f"{path} may be one of several formats: say which by --importer")
    if not found:
        raise CheckpointError(
            f"{path} is no checkpoint that {' or '.join(names)} knows; it holds "
            f"{', '.join(map(str, list(content)[:5])) or 'nothing'}"
        )
    return found[0]


def recipe_of(found: ForeignModel, overrides: Sequence[str]) -> Recipe:
    """The recipe that a checkpoint implies, changed by overrides.

    Raises:
        RecipeError: an override is wrong.
        CheckpointError: no override says what the checkpoint does not tell.
    """
    told = with_overrides({}, overrides)
    for name, reason in found.untold.items():
        section, _, parameter = name.partition(".")
        if parameter not in told.get(section, {}):
            raise CheckpointError(f"{reason}: add the override {name}=…")
    environment = told.get("env", {}).get("name")
    data = {"path": f"data/{environment or 'mine'}", **found.sections.get("data", {})}
    return Recipe.from_dict(with_overrides({**found.sections, "data": data}, overrides))


def convert(found: ForeignModel, recipe: Recipe) -> State:
    """The weights under the names of a `WorldModel`, in float32.

    Raises:
        CheckpointError: a tensor is missing, unexpected or of another shape.
        PluginError: the importer made something else than the model and conditioner take.
    """
    with torch.device("meta"):
        model = build_model(recipe.model, Flow(**recipe.flow), found.latent_channels)
        conditioner = build_conditioner(
            recipe.conditioner, model, found.action_size, found.temporal_stride
        )
    states = found.convert(model, conditioner)
    weights: State = {}
    for prefix, module, state in zip(
        ("model", "conditioner"), (model, conditioner), states, strict=True
    ):
        for name, expected in module.state_dict().items():
            if name not in state or state[name].shape != expected.shape:
                raise PluginError(f"the importer gives the {prefix} no {name} of its shape")
            if not state[name].isfinite().all():
                raise CheckpointError(
                    f"weights of {prefix}.{name} are not finite: training diverged"
                )
            weights[f"{prefix}.{name}"] = state[name].float()
    return weights


def _importer(name: str) -> CheckpointImporter:
    made = catalog().create("importer", name)
    if not isinstance(made, CheckpointImporter):
        raise PluginError(f"importer {name!r} makes a {type(made).__name__}")
    return made


def _content(path: Path) -> Mapping[str, Any]:
    try:
        if path.suffix == ".safetensors":
            return cast(Any, safetensors.torch).load_file(path)
        content = load_plain(path, on_disk=True)
    except (OSError, safetensors.SafetensorError, DataError) as error:
        message = str(error) if isinstance(error, DataError) else f"{path} cannot be read: {error}"
        raise CheckpointError(message) from error
    if not isinstance(content, Mapping):
        raise CheckpointError(f"{path} holds a {type(content).__name__}, no checkpoint")
    return cast(Mapping[str, Any], content)


def _card(recipe: Recipe, action_size: int, checkpoint: Path) -> DatasetCard:
    """The card of the dataset, where it is there, or one that says where the weights came from."""
    path = recipe.data["path"]
    if recipe.env is None or ":" in path or (Path(path) / CARD).is_file():
        card = _card_of_data(recipe, path, action_size)
    else:
        card = _card_of_environment(recipe.env, checkpoint)
    found = card.environment
    if recipe.env and recipe.env.name != found.name:
        raise DataError(
            f"{path} holds episodes of {found.name}, not of env={recipe.env.name}: leave one of "
            "the overrides out"
        )
    if found.action.size != action_size:
        raise DataError(
            f"the checkpoint takes actions of size {action_size}, and those of {found.name} have "
            f"{found.action.size}"
        )
    return card


def _card_of_data(recipe: Recipe, path: str, action_size: int) -> DatasetCard:
    try:
        return DatasetCard.read(data_folder(path))
    except DataError:
        if recipe.env is None and path == "data/mine":
            fitting = ", ".join(f"env={name}" for name in _environments(action_size))
            raise CheckpointError(
                f"the checkpoint takes actions of size {action_size} and does not say what they "
                f"mean: add data.path=FOLDER{' or one of ' if fitting else ''}{fitting}"
            ) from None
        raise


def _card_of_environment(choice: ComponentConfig, checkpoint: Path) -> DatasetCard:
    with checkpoint.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    card = _environment_card(choice.name)
    size = resolve_size(choice.params.get("size"), card.frame_size)
    return DatasetCard(
        environment=replace(card, frame_size=size),
        splits={},
        seed=0,
        options={},
        factors={},
        shard_episodes=1,
        versions=package_versions(),
        source={"kind": "checkpoint", "name": checkpoint.name, "sha256": digest},
    )


def _environment_card(name: str) -> EnvironmentCard:
    card: object = getattr(catalog().component("environment", name).load(), "card", None)
    if not isinstance(card, EnvironmentCard):
        raise PluginError(f"environment {name!r} has no EnvironmentCard")
    return card


def _environments(action_size: int) -> Iterable[str]:
    """Names of the environments that can be used here and take such actions."""
    for part in catalog().registry("environment"):
        try:
            card = _environment_card(part.name)
        except (AcwmError, ImportError):  # not installed or broken: no answer, but no matter
            continue
        if card.action.size == action_size:
            yield part.name
