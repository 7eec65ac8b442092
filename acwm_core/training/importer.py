"""The `CheckpointImporter` interface: other programs' training checkpoints, read as ours."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from acwm_core.assembly import build_conditioner, build_model
from acwm_core.conditioner import Conditioner
from acwm_core.dynamics import DynamicsModel
from acwm_core.errors import CheckpointError, PluginError
from acwm_core.flow import Flow
from acwm_core.recipe import Recipe
from acwm_core.recipe.compose import merge, read_recipe, recipe_folder, with_overrides

State = dict[str, Tensor]
"""What `load_state_dict` takes."""


@dataclass(frozen=True)
class ForeignModel:
    """A world model found in a checkpoint.

    Attributes:
        sections: of a recipe, as the weights were trained: at least `model`, `conditioner` and
            `codec`.
        latent_channels: channels C of the codec's latents.
        temporal_stride: actions per latent frame.
        action_size: dimensions A of an action.
        step: optimiser steps behind the weights; 0 if the checkpoint does not say.
        convert: the states of the model and the conditioner that the sections name, which are
            handed to it (built on the meta device). Raises `CheckpointError` with the name of a
            tensor that is missing, unexpected or of another shape.
        untold: parameters that must be set by an override, because the weights don't tell them: the
            reason by parameter, ``{"model.heads": "…"}``.
        codec_weights: the codec's own, if the checkpoint has them, as its parameter `weights` takes
            them from a ``.safetensors`` file.
        notes: sentences for people.
    """

    sections: Mapping[str, Any]
    latent_channels: int
    temporal_stride: int
    action_size: int
    step: int
    convert: Callable[[DynamicsModel, Conditioner], tuple[State, State]]
    untold: Mapping[str, str] = field(default_factory=dict[str, str])
    codec_weights: Mapping[str, Tensor] = field(default_factory=dict[str, Tensor])
    notes: tuple[str, ...] = ()


class CheckpointImporter(ABC):
    """Knows one format of checkpoints by their content. Constructed without arguments."""

    @abstractmethod
    def read(self, content: Mapping[str, Any]) -> ForeignModel | None:
        """What a file holds, or None if it is of another format.

        Args:
            content: plain Python values and CPU tensors, which may lie on disk until they are
                used: what ``torch.load`` returns of a file in which nothing was executed, or the
                tensors of a ``.safetensors`` file by name.

        Raises:
            CheckpointError: it is of this format, but something is missing or wrong.
        """

    @abstractmethod
    def example(self) -> tuple[dict[str, Any], tuple[str, ...]]:
        """A small content of this format with random weights, and overrides for its import.

        The conformance suite imports it, whole and damaged.
        """


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
    usual = {"evaluation": read_recipe(recipe_folder() / "base.yaml")["evaluation"]}
    sections = merge(usual, {**found.sections, "data": data})
    return Recipe.from_dict(with_overrides(sections, overrides))


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
    modules = {"model": model, "conditioner": conditioner}
    weights: State = {}
    for (prefix, module), state in zip(
        modules.items(), found.convert(model, conditioner), strict=True
    ):
        for name, expected in module.state_dict().items():
            if name not in state or state[name].shape != expected.shape:
                raise PluginError(f"the importer gives the {prefix} no {name} of its shape")
            if not state[name].isfinite().all():
                raise CheckpointError(f"weights of {prefix}.{name} are not finite: it diverged")
            weights[f"{prefix}.{name}"] = state[name].float()
    return weights
