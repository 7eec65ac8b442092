"""`acwm list`, `acwm show` and `acwm check`: list components, print a recipe, check a component."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any

import click

from acwm_core.cli.arguments import split_parameters
from acwm_core.errors import RecipeError, sentence, unknown_name
from acwm_core.plugins import Component, catalog

if TYPE_CHECKING:
    from rich.table import Table

SECTIONS: Mapping[str, str] = {
    "environment": "env",
    **{kind: kind for kind in ("codec", "model", "conditioner", "objective", "metric")},
}
"""Kinds whose parameters can be set by overrides, and the section that such overrides name."""


def _kinds(ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[str]:
    """What `acwm list` lists, for shells to complete."""
    return [kind for kind in (*catalog().kinds, "kind", "recipe") if kind.startswith(incomplete)]


@click.command("list")
@click.argument("kind", required=False, shell_complete=_kinds)
def list_components(kind: str | None) -> None:
    """List the installed components, or the recipes.

    Recipes use these names; an estimator has the name of its environment, and a task is
    ENVIRONMENT.TASK. Prints how many components each kind has, then each component with its plugin
    and missing requirements. KIND lists one kind only, such as environment or codec; recipe lists
    the recipes that `acwm fit` takes.
    """
    from rich.console import Console

    console = Console(highlight=False)
    if kind == "recipe":
        console.print(_recipes())
        return
    known = catalog().kinds
    if kind not in (None, "kind", *known):
        raise unknown_name("kind", kind, [*known, "kind", "recipe"])
    if kind is None:
        console.print(_counts(), end="\n\n")
    for name in [kind] if kind else known:
        console.print(_table(name, with_tasks=kind == "task"), end="\n\n")
    for problem in catalog().problems:
        console.print(f"plugin {problem.plugin!r} was left out: {problem.reason}", markup=False)


def _recipes() -> Table:
    from rich.markup import escape
    from rich.table import Table

    from acwm_core.recipe import recipe_summaries

    table = Table("recipe", "summary", box=None)
    for row in recipe_summaries().items():
        table.add_row(*map(escape, row))
    return table


def _counts() -> Table:
    from rich.table import Table

    from acwm_core.recipe import recipe_summaries

    table = Table("number", "`acwm list KIND`", box=None)
    for kind in catalog().kinds:
        table.add_row(str(len(list(catalog().registry(kind)))), kind)
    table.add_row(str(len(recipe_summaries())), "recipe")
    return table


def _table(kind: str, with_tasks: bool) -> Table:
    """The components of a kind; `with_tasks` imports tasks to ask them what they are."""
    from rich.markup import escape
    from rich.table import Table

    table = Table(title=_plural(kind), title_justify="left", title_style="bold", box=None)
    table.add_column("name", no_wrap=True)
    for column in ("plugin", "summary"):
        table.add_column(column, overflow="fold")
    for component in catalog().registry(kind):
        tasks = f"; tasks: {', '.join(component.tasks)}" if component.tasks else ""
        about = _task_summary(component) if with_tasks else component.summary
        needs = f" [red]({escape(component.needs)})[/red]" if component.needs else ""
        table.add_row(component.name, component.plugin, escape(about + tasks) + needs)
    return table


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

    click.echo(compose(recipe, overrides, trusted=True).to_yaml(), nl=False)


@click.command()
@click.argument("name")
@click.argument("overrides", nargs=-1)
def check(name: str, overrides: tuple[str, ...]) -> None:
    """Run the conformance suite on the component NAME.

    NAME is a name from `acwm list`. OVERRIDES set its parameters as in a recipe:
    codec.weights=data/wan, metric.network=vgg. env=NAME sets the environment to test a metric on.
    Exit code 1 if a check fails.
    """
    kinds = [kind for kind in catalog().kinds if name in catalog().registry(kind)]
    if not kinds:
        known = {
            component.name for kind in catalog().kinds for component in catalog().registry(kind)
        }
        raise unknown_name("component", name, known)
    suites = {kind: suite for kind in kinds if (suite := _suite(kind))}
    if not suites:
        raise RecipeError(f"{name} cannot be checked: there are no checks of {_plural(kinds[0])}")
    parameters = _parameters_of_suites(name, [*suites], overrides)
    failed = 0
    for kind, suite in suites.items():
        click.echo(f"{kind} {name}")
        for result in resolve_name(suite)(name, **parameters[kind]):
            failed += not result.passed
            click.echo(f"  {result}")
    if failed:
        click.echo(f"{failed} failed", err=True)
        raise click.exceptions.Exit(1)


def _suite(kind: str) -> str | None:
    """The target of a kind's conformance suite, if it has one."""
    return catalog().component("kind", kind).defaults.get("check")


def _task_summary(task: Component) -> str:
    """The phrase for a task, which is asked for it unless it was registered with one."""
    try:
        return task.summary or str(task.load().summary)
    except Exception as error:  # whatever a plugin raises as it is imported
        return f"({sentence(error)})"


def _parameters_of_suites(
    name: str, kinds: Sequence[str], overrides: Sequence[str]
) -> dict[str, dict[str, Any]]:
    parameters: dict[str, dict[str, Any]] = {kind: {} for kind in kinds}
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


def _plural(kind: str) -> str:
    return f"{kind.replace('_', ' ')}s"
