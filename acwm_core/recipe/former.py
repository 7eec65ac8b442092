"""Reads recipes and evaluation settings that earlier versions of acwm wrote."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from acwm_core.recipe.objective import objective_of
from acwm_core.recipe.sections import mapping_or_empty

_FOLLOWS = "follows_model"
"""Key of an objective that counts only with models without an objective of their own."""

_SETTINGS = {"floor_episodes": "noise_floor_episodes"}


def current_settings(evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of an evaluation under their present names."""
    return {_SETTINGS.get(name, name): value for name, value in evaluation.items()}


def current_sections(sections: Mapping[str, Any], below: Any = None) -> dict[str, Any]:
    """Sections of a recipe file as they are written today.

    Until 0.1, the objective was a parameter of the section `flow`, a model had `previous`, which
    follows from the objective, and `data.skip_damaged` passed over shards. Until 0.2,
    `objective.motion_steps` was `training.agent_steps`, and an objective could say `follows_model`.

    Args:
        sections: components are written out, as in ``{"model": {"name": "dit_s"}}``.
        below: the section `model` of what the file extends.
    """
    current = {name: value for name, value in sections.items() if name != "flow"}
    for section, name in (("model", "previous"), ("data", "skip_damaged")):
        if isinstance(values := current.get(section), Mapping):
            kept = cast(Mapping[str, Any], values).items()
            current[section] = {key: value for key, value in kept if key != name}
    if isinstance(evaluation := current.get("evaluation"), Mapping):
        current["evaluation"] = current_settings(cast(Mapping[str, Any], evaluation))
    if flow := sections.get("flow"):
        current["objective"] = _objective(flow, current.get("objective"))
    model = mapping_or_empty(current.get("model") or below)
    return _with_motion_steps(_with_objective_of(model, current))


def _with_objective_of(model: Mapping[str, Any], sections: dict[str, Any]) -> dict[str, Any]:
    """The sections without an objective that a model with one of its own does not learn by."""
    objective = dict(mapping_or_empty(sections.get("objective")))
    if not objective.pop(_FOLLOWS, False):
        return sections
    others = {name: value for name, value in sections.items() if name != "objective"}
    return others if objective_of(model) else {**others, "objective": objective}


def _with_motion_steps(sections: dict[str, Any]) -> dict[str, Any]:
    training: Any = sections.get("training")
    if not isinstance(training, Mapping) or "agent_steps" not in training:
        return sections
    values = dict(cast(Mapping[str, Any], training))
    steps, current = values.pop("agent_steps"), {**sections, "training": values}
    if steps:
        current["objective"] = {"motion_steps": steps, **(sections.get("objective") or {})}
    return current


def _objective(flow: Any, given: Any) -> Any:
    if not isinstance(flow, Mapping):
        return flow  # the check of the section says what is wrong
    values = dict(cast(Mapping[str, Any], flow))
    if "objective" in values:
        values = {"name": values.pop("objective"), _FOLLOWS: True, **values}
        if values["name"] != "next_frame":  # others had these parameters too, without an effect
            values = {key: v for key, v in values.items() if key not in ("past_noise", "own_past")}
    return {**values, **cast(Mapping[str, Any], given or {})}
