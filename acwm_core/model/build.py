"""Build a `WorldModel` from a recipe and an environment card, with components that fit together."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Generator
from dataclasses import replace
from typing import Any, Protocol, TypeVar, cast

import torch
from torch import nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from acwm_core.env.environment import EnvironmentCard
from acwm_core.errors import PluginError, RecipeError
from acwm_core.model.codec import Codec
from acwm_core.model.conditioner import Conditioner, takes_widths
from acwm_core.model.denoiser import Denoiser
from acwm_core.model.dynamics import DynamicsModel
from acwm_core.model.flow import Flow
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_core.recipe import ComponentConfig, Recipe

ComponentT = TypeVar("ComponentT")

MAX_TENSORS = 5_000
"""Largest number of weight tensors of a component; the largest models have hundreds of layers."""


def build_codec(choice: ComponentConfig) -> Codec:
    """Build the codec that a recipe names.

    Raises:
        UnknownNameError: no codec has that name.
        PluginError: the registered target is not a `Codec`, or has an invalid attribute.
    """
    codec = build_component("codec", choice, Codec)
    for name in ("channels", "spatial_stride", "temporal_stride"):
        if not isinstance(value := getattr(codec, name), int) or value < 1:
            raise PluginError(f"codec {choice.name!r} has {name}={value!r}, not a positive integer")
    return codec


class CardOfData(Protocol):
    """The card of a dataset, e.g. `EpisodeDataset.card`, which holds the environment's card."""

    @property
    def environment(self) -> EnvironmentCard:
        """The card of the environment that the data shows."""
        ...


def build_world_model(recipe: Recipe, card: EnvironmentCard | CardOfData) -> WorldModel:
    """Build codec, model and conditioner from a recipe, with freshly initialised weights.

    Values that one component needs from another (latent channels, width, action size, causality)
    are passed on here, so that recipes need not repeat them.

    Args:
        card: the card of the dataset or of its environment; gives the action's size and bounds.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: a component cannot be created.
        RecipeError: the model cannot be trained with the recipe's objective or on its clips.
    """
    card = card if isinstance(card, EnvironmentCard) else card.environment
    codec = build_codec(recipe.codec)
    flow = Flow(**recipe.flow)
    model = build_model(recipe.model, flow, codec.channels)
    conditioner = build_conditioner(
        recipe.conditioner, model, card.action.size, codec.temporal_stride
    )
    clips = {name: recipe.data[name] for name in ("clip_frames", "context_frames")}
    return WorldModel(codec, model, conditioner, card.action.low, card.action.high, **clips)


def build_model(choice: ComponentConfig, flow: Flow, latent_channels: int) -> DynamicsModel:
    """Build the dynamics model that a recipe names; a denoiser is causal if the objective needs it.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: the model cannot be created.
        RecipeError: the objective needs a denoiser that is causal or looks at the previous frame,
            and this one does not.
    """
    wanted = {
        "causal": flow.objective != "full_sequence",
        "previous": flow.objective == "next_frame",
    }
    left_open = {name: on for name, on in wanted.items() if choice.params.get(name, on) is None}
    choice = replace(choice, params={**choice.params, **left_open})
    model = build_component("model", choice, DynamicsModel, latent_channels=latent_channels)
    if not isinstance(model, Denoiser):
        return model
    model.flow = flow
    if wanted["previous"] and not model.previous:
        raise RecipeError(
            "flow.objective=next_frame needs a model that takes the previous frame as "
            f"input, which {choice.name} does not: choose flow.objective=diffusion_forcing"
        )
    if wanted["causal"] and not model.causal:
        raise RecipeError(
            f"flow.objective={flow.objective} needs a model that is causal in time, but "
            f"{choice.name} with these parameters is not: set model.causal=true if it has that "
            "parameter, or flow.objective=full_sequence"
        )
    return model


def build_conditioner(
    choice: ComponentConfig, model: DynamicsModel, action_size: int, temporal_stride: int
) -> Conditioner:
    """Build the conditioner that a recipe names, to fit a model.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: it cannot be created.
        RecipeError: it has layers of its own, which cannot follow the model's different widths.
    """
    follows = takes_widths(catalog().component("conditioner", choice.name).load())
    conditioner = build_component(
        "conditioner",
        choice,
        Conditioner,
        action_size=action_size,
        temporal_stride=temporal_stride,
        width=model.width,
        layers=model.layers,
        heads=model.heads,
        **({"widths": model.widths} if follows else {}),
    )
    acts_after_layers = type(conditioner).inject is not Conditioner.inject
    if acts_after_layers and not follows and {*model.widths} - {model.width}:
        raise RecipeError(
            f"conditioner={choice.name} follows layers of one width only, and those of this "
            f"{type(model).__name__} are {', '.join(map(str, model.widths))} wide: choose another "
            "conditioner, or let it take the argument widths"
        )
    return conditioner


def build_component(
    kind: str, choice: ComponentConfig, base: type[ComponentT], **fitted: Any
) -> ComponentT:
    """Build the component that a recipe names, which must be a `base`.

    Args:
        **fitted: constructor arguments that follow from the other components.

    Raises:
        UnknownNameError, MissingExtraError: it cannot be created.
        PluginError: the registered target is not a `base`.
    """
    component = catalog().component(kind, choice.name)
    what = f"{kind}={choice.name}"
    if kind in ("model", "conditioner"):  # others may load weights in their constructor
        fork = cast(Any, torch.random).fork_rng(devices=[])
        with contextlib.suppress(*_NOT_ABSTRACT), _bounded(what), fork, torch.device("meta"):
            component.create_as(base, **fitted, **choice.params)
    with _bounded(what):
        return component.create_as(base, **fitted, **choice.params)


_NOT_ABSTRACT = (RuntimeError, NotImplementedError, ValueError, TypeError)
"""Errors of a component that cannot be built on the meta device. Real errors are raised again by
the build that follows."""


@contextlib.contextmanager
def _bounded(what: str) -> Generator[None]:
    """Stop the construction of a component once it exceeds the memory of this machine."""
    memory, held = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"), [0, 0]

    def count(_module: nn.Module, _name: str, parameter: nn.Parameter | None) -> None:
        if parameter is not None:
            held[0] += 1
            held[1] += parameter.numel() * parameter.itemsize
        if held[0] > MAX_TENSORS or held[1] > memory:
            raise RecipeError(
                f"{what} is too large as the recipe has it: more than {MAX_TENSORS} weight tensors "
                f"or the {memory / 1e9:.0f} GB of this machine; make it smaller"
            )

    hook = register_module_parameter_registration_hook(count)
    try:
        yield
    finally:
        hook.remove()
