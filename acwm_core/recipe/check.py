"""Check a composed recipe: names and light sections at once, then the components' parameters."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pkgutil import resolve_name
from typing import Any, cast

from acwm_core.errors import RecipeError, suggest
from acwm_core.plugins import Component, catalog
from acwm_core.recipe import types
from acwm_core.recipe.metrics import LIBRARY_CLASS, MetricConfig, class_of_library, metric_configs
from acwm_core.recipe.objective import with_objective
from acwm_core.recipe.sections import COMPONENTS
from acwm_core.recipe.signature import REQUIRED, Signature, signature

SECTIONS = {
    "training": "acwm_core.training.config:TrainingConfig",
    "data": "acwm_core.data.clips:DataConfig",
    "evaluation": "acwm_core.evaluation.config:EvaluationConfig",
}
"""For each section that is neither a component nor `trainer`, the class that gets its values. They
are checked without importing torch."""

FITTED = {
    "model": ("latent_channels",),
    "conditioner": ("action_size", "temporal_stride", "width", "layers", "heads", "widths"),
}
"""Parameters that follow from the other components and the dataset, never from a recipe. A model
may name further ones in `fitted_parameters`."""


def validate(recipe: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Check a composed recipe and write out every default.

    Flags of `trainer` keep their values: Lightning's defaults depend on the machine, and their
    types are checked when training starts.

    Returns:
        The parameters of each section, converted to the types of their constructors. Components
        also have a `name`; an optional component that was not given is missing.
    """
    recipe = with_objective(recipe)
    values = check_names(recipe)
    listed, evaluation = _metrics(values["evaluation"]), values["evaluation"]
    for name, config in listed.items():
        check_metric_params(f"evaluation.metrics.{name}", config.component, config.params)
    options: Mapping[str, Mapping[str, Any]] = evaluation["metric_options"] or {}
    for name, params in options.items():
        component = listed[name].component if name in listed else name
        check_metric_params(f"evaluation.metric_options.{name}", component, params)
    return values | {
        section: check_component(section, recipe[section])
        for section in COMPONENTS
        if recipe.get(section)
    }


def check_names(recipe: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Check all that needs no torch: names of sections, components and flags, light sections.

    Returns:
        The values of the sections that are not components; the light ones with all defaults.

    Raises:
        RecipeError: an unknown section, component or flag, a wrong type, or something missing.
    """
    recipe = with_objective(recipe)
    plain = (*SECTIONS, "trainer")
    for name in recipe:
        if name not in (*COMPONENTS, *plain):
            near = _with_section(name) or suggest(name, (*COMPONENTS, *plain))
            raise RecipeError(f"unknown section {name!r}{near}")
    for section in COMPONENTS:
        if section != "env" or recipe.get(section):  # env is optional: datasets know theirs
            _component(section, recipe.get(section))
    values = {section: dict(_mapping(section, recipe.get(section) or {})) for section in plain}
    for section in SECTIONS:
        values[section] = check_section(section, values[section])
    values["trainer"] = _ordered_flags(values["trainer"])
    together = resolve_name("acwm_core.training.config:check_together")
    together(values["training"], values["trainer"])
    for config in _metrics(values["evaluation"]).values():
        catalog().component("metric", config.component.partition(".")[0])
    return values


def check_section(section: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Check the values of one of `SECTIONS`; return them with all defaults."""
    config = resolve_name(SECTIONS[section])
    values = _check(section, signature(config), given)
    config(**values)  # checks ranges and combinations, which types cannot express
    return values


def check_component(section: str, choice: Any) -> dict[str, Any]:
    """Check the component of a section, its `name` and parameters; imports the component.

    The parameters that all environments have are checked without importing the simulator. Where a
    component's requirements are not installed, its parameters are not checked.
    """
    component, params = _component(section, choice)
    params = _without_retired(section, component, params)
    values = {**component.defaults, **params}
    takes = signature(resolve_name("acwm_core.env.environment:Environment"))
    if section != "env" or values.keys() - takes.parameters:
        takes = _signature_of(component)
    fitted = (*FITTED.get(section, ()), *_fitted_by(component))
    return {"name": component.name, **_check(section, takes, values, fitted)}


def check_metric_params(where: str, metric: str, params: Mapping[str, Any]) -> dict[str, Any]:
    """Check the parameters of a metric; return them converted to the types of its constructor.

    Args:
        where: where they were given, for the message.
        metric: registered name, or ``LIBRARY.path.Class`` of a registered ``LIBRARY``.
        params: its parameters; without any, the metric is not imported.

    Raises:
        RecipeError: an unknown metric or parameter, or a wrong type.
        PluginError: a registered target does not exist.
    """
    registered, dot, _ = metric.partition(".")
    component = catalog().component("metric", registered)
    if dot and LIBRARY_CLASS not in _signature_of(component).parameters:
        raise RecipeError(f"{where}: {registered!r} is a metric itself, so there is no {metric}")
    if dot:
        takes = signature(class_of_library(metric))
        # What it passes on to its base class is about processes, not about what is measured.
        takes = takes._replace(open=takes.open and not takes.parameters)
    else:
        takes = _signature_of(component) if params else Signature(registered, {})
    return _check(where, takes, params, expand=False)


def _component(section: str, choice: Any) -> tuple[Component, dict[str, Any]]:
    """The component that a section chooses, and the parameters that it gives."""
    params = dict(_mapping(section, choice or {}))
    name = params.pop("name", None)
    if not isinstance(name, str):
        raise RecipeError(f"the recipe names no {section}; add {section}=NAME (see `acwm list`)")
    return catalog().component("environment" if section == "env" else section, name), params


def _without_retired(
    section: str, component: Component, params: Mapping[str, Any]
) -> dict[str, Any]:
    """The parameters without those that only earlier versions of the component had."""
    for name, kept in component.retired.items():
        if name in params and kept is not ... and params[name] != kept:
            raise RecipeError(
                f"{section}.{name}={types.show(params[name])}: {component.name} has no parameter "
                f"{name!r} any more, and behaves like {types.show(kept)} did"
            )
    return {name: value for name, value in params.items() if name not in component.retired}


def _fitted_by(component: Component) -> tuple[str, ...]:
    """The further parameters of a component that never come from a recipe."""
    if component.kind != "model" or component.missing_modules():
        return ()
    return getattr(component.load(), "fitted_parameters", ())


def _signature_of(component: Component) -> Signature:
    if component.missing_modules():
        return Signature(component.name, {}, open=True)
    return signature(component.load())


def _metrics(evaluation: Mapping[str, Any]) -> dict[str, MetricConfig]:
    listed = metric_configs(evaluation["metrics"])
    return listed | metric_configs(evaluation["counterfactual_metrics"])


def _ordered_flags(flags: Mapping[str, Any]) -> dict[str, Any]:
    """Check the names of the flags of Lightning's Trainer, and of the loggers among them."""
    known = _trainer_flags()
    for name, value in flags.items():
        if name not in known:
            raise _unknown("trainer", name, value, Signature("Trainer", known))
    resolve_name("acwm_core.training.config:chosen_loggers")(flags)
    return {name: flags[name] for name in known if name in flags}


def _trainer_flags() -> dict[str, Any]:
    return dict.fromkeys(resolve_name("acwm_core.training.config:TRAINER_FLAGS"))


def _mapping(section: str, values: Any) -> Mapping[str, Any]:
    if not isinstance(values, Mapping):
        given = types.show(values)
        raise RecipeError(f"{section}={given}: give parameters, as in {section}.parameter=value")
    return cast(Mapping[str, Any], values)


def _check(
    section: str,
    taken: Signature,
    values: Mapping[str, Any],
    fitted: Collection[str] = (),
    *,
    expand: bool = True,
) -> dict[str, Any]:
    """Check the values of a section's parameters; with `expand`, write out the others' defaults."""
    takes = {name: parameter for name, parameter in taken.parameters.items() if name not in fitted}
    for name, value in values.items():
        if name in fitted:
            raise RecipeError(f"{section}.{name} follows from the other components; omit it")
        if name not in takes and not taken.open:
            raise _unknown(section, name, value, taken._replace(parameters=takes))
    checked: dict[str, Any] = {}
    for name, parameter in takes.items():
        if name in values:
            where = f"{section}.{name}"
            checked[name] = types.checked(where, values[name], parameter.type)
        elif expand and parameter.default is REQUIRED:
            raise RecipeError(f"{taken.owner} needs the parameter {name!r}; add {section}.{name}=…")
        elif expand and _is_plain(parameter.default):
            checked[name] = parameter.default
    return checked | {name: value for name, value in values.items() if name not in takes}


def _unknown(section: str, name: str, value: Any, taken: Signature) -> RecipeError:
    near = _with_section(name) or suggest(name, taken.parameters)
    given = f"{section}.{name}={types.show(value)}"
    return RecipeError(f"{given}: {taken.owner} has no parameter {name!r}{near}")


def _with_section(name: str) -> str:
    """A hint if `name` is a parameter of a light section or of Lightning's Trainer."""
    known = {
        section: signature(resolve_name(target)).parameters for section, target in SECTIONS.items()
    }
    owners = [s for s, names in {**known, "trainer": _trainer_flags()}.items() if name in names]
    return f"; did you mean {owners[0]}.{name}?" if owners else ""


def _is_plain(value: Any) -> bool:
    """Whether a default can be written to a file."""
    try:
        json.dumps(value)
    except TypeError:
        return False
    return True
