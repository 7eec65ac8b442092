"""The `CheckpointImporter` interface: reads training checkpoints of other programs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from acwm_core.errors import DataError, PluginError
from acwm_core.model.build import build_conditioner, build_model, build_objective
from acwm_core.model.conditioner import Conditioner
from acwm_core.model.dynamics import DynamicsModel, ModelInputs
from acwm_core.recipe import Recipe
from acwm_core.recipe.compose import merge, read_recipe, recipe_folder, with_overrides

State = dict[str, Tensor]
"""A state dict, as `load_state_dict` takes it."""


@dataclass(frozen=True)
class ForeignModel:
    """A world model found in a checkpoint.

    Attributes:
        sections: recipe sections that describe how the weights were trained: at least `model`,
            `conditioner` and `codec`.
        latent_channels: channels C of the codec's latents.
        temporal_stride: actions per latent frame.
        action_size: dimensions A of an action.
        step: number of optimiser steps of the weights; 0 if the checkpoint does not say.
        convert: takes the model and conditioner that the sections name, built on the meta device,
            and returns their state dicts. Raises `DataError` with the name of a tensor that
            is missing, unexpected or of another shape.
        untold: parameters that an override must set because the weights do not reveal them: the
            reason by parameter, ``{"model.heads": "…"}``.
        codec_weights: the codec's weights, if the checkpoint has them, in the form in which its
            parameter `weights` takes them from a ``.safetensors`` file.
        notes: sentences for the user.
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
    """Recognises and reads one format of checkpoints. Constructed without arguments."""

    @abstractmethod
    def read(self, content: Mapping[str, Any]) -> ForeignModel | None:
        """Read the content of a file, or return None if it has another format.

        Args:
            content: plain Python values and CPU tensors, which may stay on disk until they are
                used: the result of ``torch.load`` without executing code of the file, or the
                tensors of a ``.safetensors`` file by name.

        Raises:
            DataError: it has this format, but something is missing or wrong.
        """

    @abstractmethod
    def example(self) -> tuple[dict[str, Any], tuple[str, ...]]:
        """Small content of this format with random weights, and overrides for its import.

        The conformance suite imports it, both intact and damaged.
        """


def recipe_of(checkpoint: ForeignModel, overrides: Sequence[str]) -> Recipe:
    """The recipe that a checkpoint implies, changed by overrides.

    Raises:
        RecipeError: an override is wrong.
        DataError: an override is missing for a parameter that the checkpoint lacks.
    """
    told = with_overrides({}, overrides)
    for name, reason in checkpoint.untold.items():
        section, _, parameter = name.partition(".")
        if parameter not in told.get(section, {}):
            raise DataError(f"{reason}: add the override {name}=…")
    environment = told.get("env", {}).get("name")
    data = {"path": f"data/{environment or 'mine'}", **checkpoint.sections.get("data", {})}
    usual = {"evaluation": read_recipe(recipe_folder() / "base.yaml")["evaluation"]}
    sections = merge(usual, {**checkpoint.sections, "data": data})
    return Recipe.from_dict(with_overrides(sections, overrides))


def convert(checkpoint: ForeignModel, recipe: Recipe) -> State:
    """The weights under the names of a `WorldModel`, in float32.

    Raises:
        DataError: a tensor is missing, unexpected or of another shape.
        PluginError: the importer's state dicts do not fit the model and conditioner.
    """
    with torch.device("meta"):
        inputs = ModelInputs(checkpoint.latent_channels, checkpoint.temporal_stride)
        model = build_model(recipe.model, build_objective(recipe.objective), inputs)
        conditioner = build_conditioner(
            recipe.conditioner, model, checkpoint.action_size, checkpoint.temporal_stride
        )
    modules = {"model": model, "conditioner": conditioner}
    weights: State = {}
    for (prefix, module), state in zip(
        modules.items(), checkpoint.convert(model, conditioner), strict=True
    ):
        for name, expected in module.state_dict().items():
            if name not in state or state[name].shape != expected.shape:
                raise PluginError(f"the importer gives the {prefix} no {name} of its shape")
            if not state[name].isfinite().all():
                raise DataError(f"weights of {prefix}.{name} are not finite: it diverged")
            weights[f"{prefix}.{name}"] = state[name].float()
    return weights
