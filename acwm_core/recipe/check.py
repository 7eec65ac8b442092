"""Check names, parameters and types of a composed recipe, without importing the components."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pkgutil import resolve_name
from typing import Any, cast

from acwm_core.errors import PluginError, RecipeError, suggest
from acwm_core.plugins import Component, ComponentKind, catalog
from acwm_core.recipe import types
from acwm_core.recipe.compose import COMPONENTS
from acwm_core.recipe.metrics import library_signature, metric_configs
from acwm_core.recipe.signature import Signature, signature

SECTIONS = {
    "flow": "acwm_core.model.flow:Flow",
    "training": "acwm_core.training.config:TrainingConfig",
    "data": "acwm_core.data.clips:DataConfig",
    "evaluation": "acwm_core.evaluation.config:EvaluationConfig",
    "trainer": "lightning.pytorch.trainer.trainer:Trainer",
}
"""For each section that is not a component, the class that receives its parameters."""

_LIGHT = ("training", "data", "evaluation")
"""Sections whose classes import nothing heavy, so they are constructed to check their values."""

FITTED = {
    "model": ("latent_channels",),
    "conditioner": ("action_size", "temporal_stride", "width", "layers", "heads", "widths"),
}
"""Parameters that follow from the other components and the dataset, never from a recipe."""


def validate(recipe: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Check a composed recipe and write out every default.

    Lightning's own defaults for `trainer` are not written out, as some depend on the machine.

    Returns:
        The parameters of each section, converted to the types of their constructors. Components
        also have a `name`; an optional component that was not given is missing.

    Raises:
        RecipeError: an unknown section, component or parameter, a wrong type, or something missing.
        PluginError: a registered target does not exist.
    """
    sections = (*COMPONENTS, *SECTIONS)
    for name in recipe:
        if name not in sections:
            raise RecipeError(
                f"unknown section {name!r}{_parameter(name) or suggest(name, sections)}"
            )
    checked = {
        section: check_component(section, recipe.get(section))
        for section in COMPONENTS
        if section != "env" or recipe.get(section)  # env is optional: datasets know theirs
    }
    for section, target in SECTIONS.items():
        values = _mapping(section, recipe.get(section) or {})
        takes = signature(target)
        assert takes is not None
        checked[section] = _check(section, takes, values, expand=section != "trainer")
        if section in _LIGHT:  # check ranges and combinations, which types cannot express
            resolve_name(target)(**checked[section])
    resolve_name("acwm_core.training.config:chosen_loggers")(checked["trainer"])
    _check_metrics(checked["evaluation"])
    return checked


def _parameter(name: str) -> str:
    """A hint if `name` is a parameter whose section was omitted or is wrong."""
    takes = {section: signature(target) for section, target in SECTIONS.items()}
    owners = [section for section, found in takes.items() if found and name in found.parameters]
    return f"; did you mean {owners[0]}.{name}?" if owners else ""


def check_component(section: str, choice: Any) -> dict[str, Any]:
    """Check the component of a section, its `name` and parameters, as `validate` does.

    Raises:
        RecipeError: an unknown component or parameter, or a wrong type.
        PluginError: a registered target does not exist.
    """
    params = dict(_mapping(section, choice or {}))
    name = params.pop("name", None)
    if not isinstance(name, str):
        raise RecipeError(f"the recipe names no {section}; add {section}=NAME (see `acwm list`)")
    kind: ComponentKind = "environment" if section == "env" else section  # pyright: ignore[reportAssignmentType]
    component = catalog().component(kind, name)
    takes, values = _component_signature(component), {**component.defaults, **params}
    return {"name": name, **_check(section, takes, values, FITTED.get(section, ()))}


def _check_metrics(evaluation: Mapping[str, Any]) -> None:
    listed = metric_configs(evaluation["metrics"])
    listed |= metric_configs(evaluation["counterfactual_metrics"])
    for name, config in listed.items():
        check_metric_params(f"evaluation.metrics.{name}", config.component, config.params)
    options: Mapping[str, Mapping[str, Any]] = evaluation["metric_options"] or {}
    for name, params in options.items():
        component = listed[name].component if name in listed else name
        check_metric_params(f"evaluation.metric_options.{name}", component, params)


def check_metric_params(where: str, metric: str, params: Mapping[str, Any]) -> dict[str, Any]:
    """Check the parameters of a metric; return them converted to the types of its constructor.

    Args:
        where: where they were given, for the message.
        metric: registered name, or ``LIBRARY.path.Class`` of a registered ``LIBRARY``.

    Raises:
        RecipeError: an unknown metric or parameter, or a wrong type.
        PluginError: a registered target does not exist.
    """
    registered, dot, _ = metric.partition(".")
    component = catalog().component("metric", registered)
    takes = library_signature(metric) if dot else _component_signature(component)
    return _check(where, takes, params, expand=False)


def _mapping(section: str, values: Any) -> Mapping[str, Any]:
    if not isinstance(values, Mapping):
        given = types.show(values)
        raise RecipeError(f"{section}={given}: give parameters, as in {section}.parameter=value")
    return cast(Mapping[str, Any], values)


def _component_signature(component: Component) -> Signature:
    found = signature(component.target)
    if found is None:
        raise PluginError(
            f"{component.kind} {component.name!r} of plugin {component.plugin!r} points to "
            f"{component.target}, which does not exist"
        )
    return found


def _check(
    section: str,
    reading: Signature,
    values: Mapping[str, Any],
    fitted: Collection[str] = (),
    *,
    expand: bool = True,
) -> dict[str, Any]:
    takes = {name: p for name, p in reading.parameters.items() if name not in fitted}
    for name, value in values.items():
        if name in fitted:
            raise RecipeError(f"{section}.{name} follows from the other components; omit it")
        if name not in takes and not reading.open:
            raise RecipeError(
                f"{section}.{name}={types.show(value)}: {reading.owner} has no parameter {name!r}"
                f"{_parameter(name) or suggest(name, takes)}"
            )
    checked: dict[str, Any] = {}
    for name, parameter in takes.items():
        if name in values:
            checked[name] = types.checked(f"{section}.{name}", values[name], parameter.type)
        elif parameter.value is None and expand:
            raise RecipeError(
                f"{reading.owner} needs the parameter {name!r}; add {section}.{name}=…"
            )
        elif expand and _is_plain(parameter.default):
            checked[name] = parameter.default
    return checked | {name: value for name, value in values.items() if name not in takes}


def _is_plain(value: Any) -> bool:
    """Whether a default can be written to a file; not `...`, which means it could not be read."""
    try:
        json.dumps(value)
    except TypeError:
        return False
    return True
