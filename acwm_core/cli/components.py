"""`acwm list`, `acwm show` and `acwm check`: list components, print a recipe, check a component."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

import click

from acwm_core.cli.arguments import split_parameters
from acwm_core.errors import RecipeError, UnknownNameError, sentence
from acwm_core.plugins import COMPONENT_KINDS, Component, ComponentKind

if TYPE_CHECKING:
    from acwm_core.checks import CheckResult

SECTIONS: Mapping[str, str] = {
    "environment": "env",
    **{kind: kind for kind in ("codec", "model", "conditioner", "metric")},
}
"""Kinds whose parameters can be set by overrides, and the section that such overrides name."""


@click.command("list")
@click.argument(
    "kind", type=click.Choice([*COMPONENT_KINDS, "recipe"]), required=False, metavar="[KIND]"
)
def list_components(kind: Any) -> None:
    """List the installed components, or the recipes.

    Recipes use these names; an estimator has the name of its environment, and a task is
    ENVIRONMENT.TASK. The list also shows each component's plugin and what it needs that is not
    installed. KIND lists one kind only, such as environment, codec or dataset_importer; task also
    says what each is, and recipe lists those that `acwm fit` takes.
    """
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from acwm_core.plugins import catalog

    console = Console(highlight=False)
    if kind == "recipe":
        from acwm_core.recipe import recipe_summaries

        table = Table("recipe", "summary", box=None)
        for row in recipe_summaries().items():
            table.add_row(*map(escape, row))
        console.print(table)
        return
    for shown in (kind,) if kind else COMPONENT_KINDS:
        table = Table(title=_plural(shown), title_justify="left", title_style="bold", box=None)
        table.add_column("name", no_wrap=True)
        for column in ("plugin", "summary"):
            table.add_column(column, overflow="fold")
        for component in catalog().registry(shown):
            needs = escape(what_it_needs(component))
            tasks = f"; tasks: {', '.join(component.tasks)}" if component.tasks else ""
            about = escape((_summary(component) if kind else component.summary) + tasks)
            summary = about + (f" [red]({needs})[/red]" if needs else "")
            table.add_row(component.name, component.plugin, summary)
        console.print(table, end="\n\n")
    for problem in catalog().problems:
        console.print(f"plugin {problem.plugin!r} was left out: {problem.reason}", markup=False)


@click.command()
@click.argument("recipe")
@click.argument("overrides", nargs=-1)
def show(recipe: str, overrides: tuple[str, ...]) -> None:
    """Check a recipe and print it with all defaults.

    RECIPE is a file or the name of a recipe that comes with acwm. OVERRIDES change it, as in `acwm
    fit`: conditioner=cross_attention model.layers=4 trainer.devices=2. The output is a complete
    recipe.
    """
    from acwm_core.recipe import compose

    click.echo(compose(recipe, overrides).to_yaml(), nl=False)


@click.command()
@click.argument("name")
@click.argument("overrides", nargs=-1)
def check(name: str, overrides: tuple[str, ...]) -> None:
    """Run the conformance suite on the component NAME.

    NAME is a name from `acwm list`. OVERRIDES set its parameters as in a recipe:
    codec.weights=data/wan, metric.network=vgg. env=NAME sets the environment to test a metric on.
    Exit code 1 if a check fails.
    """
    from acwm_core.plugins import catalog

    kinds: list[ComponentKind] = [
        kind for kind in COMPONENT_KINDS if name in catalog().registry(kind)
    ]
    if not kinds:
        known = {each.name for kind in COMPONENT_KINDS for each in catalog().registry(kind)}
        raise UnknownNameError("component", name, known)
    suites: dict[ComponentKind, Callable[..., Sequence[CheckResult]]] = {
        kind: suite for kind in kinds if (suite := _suite(kind))
    }
    if not suites:
        raise RecipeError(f"there are no checks of {_plural(kinds[0])}, and so none of {name}")
    parameters = _parameters_of_suites(name, [*suites], overrides)
    failed = 0
    for kind, suite in suites.items():
        click.echo(f"{kind} {name}")
        for result in suite(name, **parameters[kind]):
            failed += not result.passed
            click.echo(f"  {result}")
    if failed:
        click.echo(f"{failed} failed", err=True)
        raise click.exceptions.Exit(1)


def _suite(kind: ComponentKind) -> Callable[..., Sequence[CheckResult]] | None:
    """The conformance suite of a kind, of core or of the plugin that defines the kind."""
    from acwm_core.plugins import catalog

    brought = catalog().registry("check")
    checks = import_module("acwm_core.checks")
    return brought[kind].load() if kind in brought else getattr(checks, f"check_{kind}", None)


def what_it_needs(component: Component) -> str:
    """Which required modules are not installed, and how to install them; empty if none."""
    missing = component.missing_modules()
    return f"needs {', '.join(missing)}: {component.install_command(missing[0])}" if missing else ""


def _summary(component: Component) -> str:
    """The phrase for a component; a task that was registered without one is asked for it."""
    if component.summary or component.kind != "task":
        return component.summary
    try:
        return str(component.load().summary)
    except Exception as error:  # whatever a plugin raises as it is imported
        return f"({sentence(error)})"


def _parameters_of_suites(
    name: str, kinds: Sequence[ComponentKind], overrides: Sequence[str]
) -> dict[ComponentKind, dict[str, Any]]:
    from acwm_core.plugins import catalog

    parameters: dict[ComponentKind, dict[str, Any]] = {kind: {} for kind in kinds}
    others = list(overrides)
    for kind in kinds if overrides else ():
        if kind in SECTIONS:
            others, parameters[kind] = split_parameters(SECTIONS[kind], name, others)
        if kind == "metric":
            for override in [other for other in others if other.startswith("env=")]:
                others.remove(override)
                environment = override.removeprefix("env=")
                catalog().component("environment", environment)
                parameters[kind]["environment"] = environment
    if others:
        known = [f"{SECTIONS[kind]}.PARAMETER=VALUE" for kind in kinds if kind in SECTIONS]
        known += ["env=NAME"] * ("metric" in kinds)
        what = f"write {' or '.join(known)}" if known else "it takes no overrides"
        raise RecipeError(f"{others[0]!r} sets no parameter of {name}; {what}")
    return parameters


def _plural(kind: ComponentKind) -> str:
    return f"{kind.replace('_', ' ')}s"
