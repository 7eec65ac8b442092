"""Which objective a recipe has: the one named last, by a file or by the choice of a model."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any, cast

from acwm_core.plugins import Component, catalog
from acwm_core.recipe.sections import deep_merge, mapping_or_empty
from acwm_core.recipe.signature import signature

Layer = Mapping[str, Any]
"""What one recipe file, or all overrides together, change."""

USUAL = "full_sequence"
"""The objective of a recipe that names none."""


def objective_section(layers: Iterable[Layer], *, quick: bool = False) -> dict[str, Any]:
    """The section `objective` of a recipe that consists of some layers, the last one on top.

    A layer that names a model with an objective of its own names that objective, too, unless it
    names one itself. The model's objective holds until a layer names an objective or a model;
    without it, the one named before holds again. Parameters belong to the objective that holds
    where they are given; one that is named keeps those of former ones that it takes, too.

    Args:
        quick: leave out the parameters that are kept, for which the objective is imported.
    """
    former: dict[str, Any] = {}
    named: dict[str, Any] = {}
    of_model: dict[str, Any] = {}
    for layer in layers:
        given, model = (mapping_or_empty(layer.get(name)) for name in ("objective", "model"))
        current, own = of_model or named, objective_of(model)
        if "name" in given:
            former = {**former, **named, **of_model}
            named, of_model = current if current.get("name") == given["name"] else {}, {}
        elif "name" in model and own != current.get("name"):
            of_model = {"name": own} if own else {}
        if of_model:
            of_model = deep_merge(of_model, given)
        else:
            named = deep_merge(named, given)
    taken = _parameters(named.get("name")) if former and not (of_model or quick) else ()
    return of_model or {name: former[name] for name in taken if name in former} | named


def objective_of(model: Mapping[str, Any]) -> str | None:
    """The objective that the model of this section was registered with, if any."""
    component = _registered("model", model.get("name"))
    return component.objective if component else None


def with_objective(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """A recipe whose objective is named: by itself, by its model, or the usual one."""
    objective: Any = recipe.get("objective") or {}
    if not isinstance(objective, Mapping) or "name" in objective:
        return {**recipe}  # the check of the section says what is wrong
    name = objective_of(mapping_or_empty(recipe.get("model"))) or USUAL
    return {**recipe, "objective": {"name": name, **cast(Mapping[str, Any], objective)}}


def _parameters(objective: Any) -> Collection[str]:
    component = _registered("objective", objective)
    if component is None or component.missing_modules():
        return ()
    return signature(component.load()).parameters


def _registered(kind: str, name: Any) -> Component | None:
    registry = catalog().registry(kind)
    return registry[name] if isinstance(name, str) and name in registry else None
