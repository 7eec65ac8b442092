"""Metrics as recipes list them: by name, or with parameters and their own name. No torch."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

from acwm_core.errors import RecipeError, suggest
from acwm_core.plugins import catalog

LIBRARY_CLASS = "metric_class"
"""The parameter of a registered library of metrics that chooses one of its classes."""

MetricChoice = str | Mapping[str, Any]
"""A registered name, or the dotted name of a class whose library is a registered name. Or a mapping
with that as ``name``, optionally ``as`` (the name in the results), and the metric's parameters.
"""


@dataclass(frozen=True)
class MetricConfig:
    """One metric of a recipe."""

    name: str  # its name in the results
    component: str  # registered name, or ``LIBRARY.path.Class``
    params: Mapping[str, Any] = field(default_factory=dict[str, Any])  # constructor arguments

    def create(self) -> Any:
        """Construct the metric; for ``LIBRARY.path.Class``, as ``LIBRARY(metric_class=...)``."""
        registered, dot, _ = self.component.partition(".")
        of_library = {LIBRARY_CLASS: self.component} if dot else {}
        return catalog().create("metric", registered, **of_library, **self.params)


def metric_configs(
    metrics: Iterable[MetricChoice], options: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, MetricConfig]:
    """Read the metrics that a recipe lists, keyed by their names in the results.

    Args:
        metrics: the metrics, as listed in the recipe.
        options: further parameters, keyed by the names in the results. Parameters given directly
            with a metric take precedence.

    Raises:
        RecipeError: a mapping has no name, or a name is invalid or used twice.
    """
    configs: dict[str, MetricConfig] = {}
    for choice in metrics:
        config = _config(choice)
        if configs.get(config.name, config) != config:
            raise RecipeError(
                f"evaluation.metrics lists {config.name!r} twice: give one of them a name of its "
                f"own, as in {{name: {config.component}, as: {config.name}_2}}"
            )
        configs[config.name] = config
    for name in configs.keys() & (options or {}):
        params = {**(options or {})[name], **configs[name].params}
        configs[name] = replace(configs[name], params=params)
    return configs


def _config(choice: MetricChoice) -> MetricConfig:
    params: dict[str, Any] = {"name": choice} if isinstance(choice, str) else dict(choice)
    component, name = params.pop("name", None), params.pop("as", None)
    if not isinstance(component, str):
        raise RecipeError(
            f"evaluation.metrics={dict(cast(Any, choice))} names no metric; write {{name: METRIC, "
            "as: OWN_NAME, PARAMETER: VALUE}"
        )
    name = own_name(component) if name is None else name
    if not isinstance(name, str) or not re.fullmatch(r"[a-z]\w*", name, re.ASCII | re.IGNORECASE):
        raise RecipeError(f"evaluation.metrics: {name!r} is not a valid name; use letters and _")
    return MetricConfig(name, component, params)


def own_name(component: str) -> str:
    """The default name in the results, e.g. mean_error for ``library.image.MeanError``."""
    _, dot, name = component.rpartition(".")
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower() if dot else component


def class_of_library(component: str) -> Any:
    """Import the class ``LIBRARY.path.Class``.

    Raises:
        RecipeError: there is no such class; suggests a similar one.
    """
    module, _, name = component.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError):
        known = [attribute for attribute in dir(sys.modules.get(module)) if attribute[:1].isupper()]
        raise RecipeError(f"there is no {component}{suggest(name, known)}") from None
