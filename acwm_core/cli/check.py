"""`acwm check`: the conformance suite for components."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

import click

from acwm_core.errors import RecipeError, UnknownNameError
from acwm_core.registry import COMPONENT_KINDS


@click.command()
@click.argument("name")
@click.argument("overrides", nargs=-1)
def check(name: str, overrides: tuple[str, ...]) -> None:
    """Check that the component NAME keeps its contract.

    NAME is anything `acwm list` shows. OVERRIDES set its parameters as in a recipe:
    codec.weights=data/wan, metric.network=vgg. What a metric is tried on is env=NAME. Exit code 1
    if a check fails.
    """
    from acwm_core.catalog import catalog

    kinds = [kind for kind in COMPONENT_KINDS if name in catalog().registry(kind)]
    if not kinds:
        known = {
            component.name for kind in COMPONENT_KINDS for component in catalog().registry(kind)
        }
        raise UnknownNameError("component", name, known)
    failed = 0
    for kind in kinds:
        parameters = _parameters("env" if kind == "environment" else kind, name, overrides)
        suite = getattr(import_module("acwm_core.checks"), f"check_{kind}", None)
        if suite is None:
            raise RecipeError(f"there are no checks of {kind}s, and so none of {name}")
        click.echo(f"{kind} {name}")
        for result in suite(name, **parameters):
            failed += not result.passed
            click.echo(f"  {result}")
    if failed:
        click.echo(f"{failed} failed", err=True)
        sys.exit(1)


def _parameters(section: str, name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """The parameters that overrides set, checked as those of a recipe are."""
    from acwm_core.catalog import catalog
    from acwm_core.recipe.compose import COMPONENTS, merge, parse_override
    from acwm_core.recipe.validate import check_component, check_metric_params

    given: dict[str, Any] = {}
    of_metric = section == "metric"
    for override in overrides:
        own = override.startswith(f"{section}.") and (of_metric or section in COMPONENTS)
        if not own and not (of_metric and override.startswith("env=")):
            what = f"{section}.PARAMETER=VALUE" + (" or env=NAME" if of_metric else "")
            raise RecipeError(f"{override!r} sets nothing of {name}; write {what}")
        given = merge(given, parse_override(override))
    chosen: dict[str, Any] = given.get(section, {})
    if of_metric:
        on = {"environment": given["env"]["name"]} if "env" in given else {}
        for environment in on.values():
            catalog().component("environment", environment)
        return {**check_metric_params(section, name, chosen), **on}
    if not chosen:
        return {}
    checked = check_component(section, {"name": name, **chosen})
    return {parameter: checked[parameter] for parameter in chosen}
