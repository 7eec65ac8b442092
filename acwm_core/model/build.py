"""Build a `WorldModel` from a recipe and an environment card, with components that fit together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol, TypeVar, cast

from acwm_core.env.environment import EnvironmentCard
from acwm_core.errors import PluginError, RecipeError
from acwm_core.model.codec import Codec
from acwm_core.model.conditioner import Conditioner
from acwm_core.model.dynamics import DynamicsModel, ModelInputs
from acwm_core.model.objectives.objective import Objective
from acwm_core.model.shapes import float32_by_default
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_core.recipe import ComponentConfig, Recipe

ComponentT = TypeVar("ComponentT")


class CardOfData(Protocol):
    """The card of a dataset, e.g. `EpisodeDataset.card`, which holds the environment's card."""

    @property
    def environment(self) -> EnvironmentCard:
        """The card of the environment that the data shows."""
        ...


@float32_by_default()
def build_world_model(recipe: Recipe, card: EnvironmentCard | CardOfData) -> WorldModel:
    """Build codec, model, conditioner and objective of a recipe, with freshly initialised weights.

    Values that one component needs from another (latent channels, width, action size, causality)
    are passed on here, so that recipes need not repeat them.

    Args:
        card: the card of the dataset or of its environment; gives the action's size and bounds.

    Raises:
        RecipeError, MissingExtraError, PluginError: a component cannot be created.
        RecipeError: the components do not fit together, or the model not the recipe's clips.
    """
    card = card if isinstance(card, EnvironmentCard) else card.environment
    codec = build_codec(recipe.codec)
    objective = build_objective(recipe.objective)
    states = state_shapes(recipe.data.get("states", ()), card)
    inputs = ModelInputs(codec.channels, codec.temporal_stride, card, tuple(states))
    model = build_model(recipe.model, objective, inputs)
    conditioner = build_conditioner(
        recipe.conditioner, model, card.action.size, codec.temporal_stride
    )
    bounds = card.action.low, card.action.high
    clips = {name: recipe.data[name] for name in ("clip_frames", "context_frames")}
    return WorldModel(codec, model, conditioner, objective, *bounds, **clips, state_shapes=states)


def state_shapes(names: Sequence[str], card: EnvironmentCard) -> dict[str, tuple[int, ...]]:
    """Shapes of some fields of the state, by name, in this order.

    Raises:
        RecipeError: there is no such field.
    """
    shapes = {field.name: field.shape for field in card.state}
    for name in names:
        if name not in shapes:
            known = ", ".join(shapes) or "none at all"
            raise RecipeError(f"data.states: {card.name} has no state {name!r}, but {known}")
    return {name: tuple(shapes[name]) for name in names}


@float32_by_default()
def build_codec(choice: ComponentConfig) -> Codec:
    """Build the codec that a recipe names."""
    codec = build_component("codec", choice, Codec)
    for name in ("channels", "spatial_stride", "temporal_stride"):
        if not isinstance(value := getattr(codec, name), int) or value < 1:
            raise PluginError(f"codec {choice.name!r} has {name}={value!r}, not a positive integer")
    return codec


def build_objective(choice: ComponentConfig) -> Objective[Any]:
    """Build the objective that a recipe names."""
    return build_component("objective", choice, cast("type[Objective[Any]]", Objective))


def build_model(
    choice: ComponentConfig, objective: Objective[Any], inputs: ModelInputs
) -> DynamicsModel:
    """Build the dynamics model that a recipe names, as the objective and the data need it.

    Raises:
        RecipeError: the model cannot learn from such data.
    """
    wanted = {"causal": objective.causal, "inputs": objective.inputs}
    left_open = {name: on for name, on in wanted.items() if choice.params.get(name, on) is None}
    choice = replace(choice, params={**choice.params, **left_open})
    maker = catalog().component("model", choice.name).load()
    fitted = getattr(maker, "fitted", DynamicsModel.fitted)  # a function has none
    model = build_component("model", choice, DynamicsModel, **fitted(inputs))
    objective.check_model(model)
    return model


def build_conditioner(
    choice: ComponentConfig, model: DynamicsModel, action_size: int, temporal_stride: int
) -> Conditioner:
    """Build the conditioner that a recipe names, to fit a model."""
    fitted: dict[str, Any] = {
        "action_size": action_size,
        "temporal_stride": temporal_stride,
        "width": model.width,
        "layers": model.layers,
        "heads": model.heads,
    }
    if {*model.widths} - {model.width}:
        fitted["widths"] = model.widths
    return build_component("conditioner", choice, Conditioner, **fitted)


def build_component(
    kind: str, choice: ComponentConfig, base: type[ComponentT], **fitted: Any
) -> ComponentT:
    """Build the component that a recipe names, which must be a `base`.

    Args:
        **fitted: constructor arguments that follow from the other components.
    """
    return catalog().component(kind, choice.name).create_as(base, **fitted, **choice.params)
