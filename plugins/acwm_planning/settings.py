"""Settings of planning: presets and overrides from the command line, checked without torch."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, cast, get_type_hints

from acwm_core.errors import RecipeError, suggest
from acwm_core.plugins import catalog
from acwm_core.recipe.check import check_component
from acwm_core.recipe.compose import parse_override
from acwm_core.recipe.types import checked, show

if TYPE_CHECKING:
    from acwm_planning.planner import Cost

ROW_NAMES = ("model", "simulator", "codec", "solution", "policy", "random", "still")
"""What chooses the actions: the planner with the model; the same planner with the true simulator;
the same again, but seen through codec and estimator; the task's scripted solution; the behaviour
policy; random actions; no motion."""

PRESETS: Mapping[str, Sequence[str]] = {
    "default": ("planner=icem", "cost=latent"),
    # The settings of stable-worldmodel: whole plans are executed, and only their end is judged.
    "stable_worldmodel": (
        *("planner=cem", "planner.candidates=300", "planner.iterations=30", "planner.elites=30"),
        *("planner.horizon=5", "planner.action_block=5", "planner.actions_per_plan=25"),
        *("planner.spread=1.0", "cost=latent", "cost.frames=1", "goal_ahead=25", "max_steps=50"),
    ),
}
"""Overrides of each preset; those of the command line are applied after them."""


@dataclass(frozen=True)
class Settings:
    """Everything that determines how an episode is planned, except the model.

    Attributes:
        planner: name and parameters of the planner.
        cost: name and parameters of the cost.
        past: see `ModelRollouts`.
        state_past: as `past`, for a cost that takes the states which a model carries on, such as
            `cost=state`; null for `past`.
        steps: see `ModelRollouts`.
        batch: see `ModelRollouts`.
        max_steps: maximum number of actions in an episode; the task's own by default.
        goal_ahead: the goal is the state that the behaviour policy reaches from the start after
            this many frames; the task's own goals by default.
    """

    planner: dict[str, Any]
    cost: dict[str, Any]
    past: int = 0
    state_past: int | None = None
    steps: int | None = None
    batch: int = 128
    max_steps: int | None = None
    goal_ahead: int | None = None

    def __post_init__(self) -> None:
        minima = {
            "past": 0,
            "state_past": 0,
            "steps": 1,
            "batch": 1,
            "max_steps": 1,
            "goal_ahead": 1,
        }
        for name, minimum in minima.items():
            value = getattr(self, name)
            if value is not None and value < minimum:
                raise RecipeError(f"{name}={value}: give {minimum} or more")

    @property
    def differentiates(self) -> bool:
        """Whether the planner needs gradients, which the simulator does not have."""
        return self.planner["name"] == "gradient"

    def rollouts(self, cost: Cost) -> dict[str, Any]:
        """The parameters of `ModelRollouts` for the cost of these settings."""
        state_past = self.state_past if cost.carried else None
        parameters = {"past": self.past, "steps": self.steps, "batch": self.batch}
        return parameters | {"state_past": state_past}

    def rows(self, names: Collection[str]) -> list[str]:
        """The rows to play of those that are asked for, in the order of `ROW_NAMES`.

        A cost that observes no pictures is the same through the codec, so then there is no such
        row.

        Raises:
            RecipeError: there is no such row.
        """
        for row in names:
            if row not in ROW_NAMES:
                raise RecipeError(f"unknown row {row!r}{suggest(row, ROW_NAMES)}")
        asked = {*names}
        if "codec" in asked and not catalog().component("cost", self.cost["name"]).load().observes:
            asked.remove("codec")
        return [row for row in ROW_NAMES if row in asked]

    def to_dict(self) -> dict[str, Any]:
        """The settings that affect results, ready for JSON; the batch size does not."""
        unset = {"batch"} | ({"state_past"} if self.state_past is None else set())
        return {name: value for name, value in asdict(self).items() if name not in unset}


def settings_of(
    overrides: Sequence[str], preset: str = "default", declared: Sequence[str] = ()
) -> Settings:
    """Build the settings from a preset and overrides, checked in the same way as a recipe.

    Args:
        overrides: e.g. ``planner=cem``, ``planner.candidates=300``, ``cost.frames=1``, ``past=2``;
            their order does not matter.
        preset: one of `PRESETS`.
        declared: overrides of the task (`Task.planning`). They apply before those of another preset
            than the default, and before `overrides`.

    Raises:
        RecipeError: a preset, component or parameter does not exist, or a value is wrong.
    """
    if preset not in PRESETS:
        raise RecipeError(f"unknown preset {preset!r}{suggest(preset, PRESETS)}")
    components: dict[str, dict[str, Any]] = {"planner": {}, "cost": {}}
    plain: dict[str, Any] = {}
    types = get_type_hints(Settings)
    names = [field.name for field in fields(Settings)]
    changes = PRESETS[preset] if preset != "default" else ()
    for words in (PRESETS["default"], declared, changes, overrides):
        items = [item for word in words for item in parse_override(word).items()]
        # names first: a new name drops the parameters of the previous component
        for name, value in sorted(items, key=lambda item: isinstance(item[1], dict)):
            if name not in names:
                raise RecipeError(f"{name} is not a setting of planning{suggest(name, names)}")
            if name not in components:
                plain[name] = checked(name, value, types[name])
            elif isinstance(value, dict):
                components[name] |= value
            elif value != components[name].get("name"):
                components[name] = {"name": value}
    checked_choices = {name: check_component(name, choice) for name, choice in components.items()}
    return Settings(**checked_choices, **plain)


def words_of(settings: Mapping[str, Any]) -> Iterator[str]:
    """The settings as overrides of `acwm plan`, and the first digits of the weights' hash."""
    for name, value in settings.items():
        if isinstance(value, Mapping):
            params = dict(cast(Mapping[str, Any], value))
            yield f"{name}={params.pop('name')}"
            yield from (f"{name}.{param}={show(v)}" for param, v in params.items())
        elif name == "weights" and value is not None:
            yield f"weights={str(value)[:12]}"
        elif name not in ("environment", "task") and value is not None:  # those are in the title
            yield f"{name}={value}"
