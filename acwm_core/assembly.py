"""From a recipe and an environment card to a `WorldModel`: every part built to fit the others."""

from __future__ import annotations

from typing import Any, TypeVar

from acwm_core.catalog import catalog
from acwm_core.codec import Codec
from acwm_core.conditioner import Conditioner
from acwm_core.dynamics import DynamicsModel
from acwm_core.environment import EnvironmentCard
from acwm_core.errors import PluginError
from acwm_core.flow import Flow
from acwm_core.recipe import PartChoice, Recipe
from acwm_core.registry import Kind
from acwm_core.world_model import WorldModel

PartT = TypeVar("PartT")


def build_codec(choice: PartChoice) -> Codec:
    """The codec that a recipe names.

    Raises:
        UnknownNameError: no codec has that name.
        PluginError: what is registered under it is no `Codec`.
    """
    return _build("codec", choice, Codec)


def build_world_model(recipe: Recipe, card: EnvironmentCard) -> WorldModel:
    """Build codec, model and conditioner from a recipe, with freshly initialised weights.

    Sizes that one part needs of another (latent channels, width, action size) are passed on here,
    so that no recipe repeats them.

    Args:
        recipe: names the parts and their parameters.
        card: the environment of the dataset; gives the action's size and bounds.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: a part cannot be had.
    """
    codec = build_codec(recipe.codec)
    model = _build("model", recipe.model, DynamicsModel, latent_channels=codec.channels)
    conditioner = _build(
        "conditioner",
        recipe.conditioner,
        Conditioner,
        action_size=card.action.size,
        temporal_stride=codec.temporal_stride,
        width=model.width,
        layers=model.layers,
        heads=model.heads,
    )
    flow = Flow(**recipe.flow)
    return WorldModel(codec, model, conditioner, flow, card.action.low, card.action.high)


def _build(kind: Kind, choice: PartChoice, base: type[PartT], **fitted: Any) -> PartT:
    part = catalog().create(kind, choice.name, **fitted, **choice.params)
    if not isinstance(part, base):
        raise PluginError(
            f"{kind} {choice.name!r} makes a {type(part).__name__}, which is no {base.__name__}"
        )
    return part
