"""Which objective a composed recipe has: the one chosen for its model, or the model's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from acwm_core.plugins import catalog

USUAL = "full_sequence"
"""The objective of a recipe that names none."""

FOLLOWS = "follows_model"
"""Key of the section `objective`: a model with an objective of its own learns by that instead. It
is set where such a model is chosen later than the objective, and where a recipe says so."""

OWN = "own"
"""Key in that section for the names of parameters that were given to the model's own objective."""

INHERITED = "inherited"
"""Key in a recipe's section `objective` for the parameters of objectives that it replaced."""


def chosen(changes: Mapping[str, Any], merged: dict[str, Any]) -> dict[str, Any]:
    """Note in a recipe, into which changes were merged, whether its objective follows its model."""
    objective: Mapping[str, Any] = changes.get("objective") or {}
    if "name" in objective and FOLLOWS not in objective:
        merged["objective"].pop(FOLLOWS, None)
    elif objective_of(changes.get("model") or {}):
        merged["objective"] = {**(merged.get("objective") or {}), FOLLOWS: True}
    section: Mapping[str, Any] = merged.get("objective") or {}
    if "name" not in objective and section.get(FOLLOWS) and objective_of(merged.get("model") or {}):
        own = sorted({*section.get(OWN, ()), *objective} - {FOLLOWS})
        merged["objective"] = {**section, OWN: own}
    return merged


def objective_of(model: Mapping[str, Any]) -> str | None:
    """The objective that the model of this section was registered with, if any."""
    models, name = catalog().registry("model"), model.get("name")
    return models[name].objective if isinstance(name, str) and name in models else None


def inherited(old: Mapping[str, Any]) -> dict[str, Any]:
    """What a new objective inherits from the section of the one that it replaces.

    The noise path has the same meaning for all objectives of flow matching, so parameters are kept
    until it is known which of them the new one takes.
    """
    before = old.get(INHERITED, {})
    notes = ("name", FOLLOWS, INHERITED, OWN)
    own = {name: value for name, value in old.items() if name not in notes}
    return {INHERITED: {**before, **own}}


def resolved(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """A composed recipe with its final objective.

    If the model was chosen without an objective, e.g. by ``model=recurrent``, it is the one that
    the model was registered with, if any, with the parameters that were given with that model or
    later; else the one that the recipe names.
    """
    objective: Any = recipe.get("objective") or {}
    if not isinstance(objective, Mapping):
        return {**recipe}  # the check of the section says what is wrong
    values = {"name": USUAL, **cast(Mapping[str, Any], objective)}
    own, given = objective_of(recipe.get("model") or {}), values.pop(OWN, ())
    follows = values.pop(FOLLOWS, False)
    if "name" not in objective and own:
        values["name"] = own
    elif follows and own:
        values = {"name": own, **{name: values[name] for name in given}}
    else:  # another model was chosen later
        values = {name: value for name, value in values.items() if name not in given}
    return {**recipe, "objective": values}
