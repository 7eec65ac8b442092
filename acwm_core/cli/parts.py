"""`acwm list` and `acwm show`: what is installed, and what a recipe says in full."""

from __future__ import annotations

import click

from acwm_core.registry import COMPONENT_KINDS, Component, ComponentKind


@click.command("list")
@click.argument("kind", type=click.Choice(COMPONENT_KINDS), required=False, metavar="[KIND]")
def list_components(kind: ComponentKind | None) -> None:
    """List every component that is installed.

    Environments, codecs, models, conditioners and metrics, by the names that recipes use;
    estimators, by the environments that they read; importers of checkpoints and
    formats of datasets; executors; with the plugin that brought them and what is not installed
    that they need. A KIND, such as environment, codec or dataset_importer, lists one kind only.
    """
    from rich.console import Console
    from rich.table import Table

    from acwm_core.catalog import catalog

    console = Console(highlight=False)
    for shown in (kind,) if kind else COMPONENT_KINDS:
        table = Table(
            title=f"{shown.replace('_', ' ')}s", title_justify="left", title_style="bold", box=None
        )
        for column in ("name", "plugin", "summary"):
            table.add_column(column, overflow="fold")
        for component in catalog().registry(shown):
            table.add_row(component.name, component.plugin, _summary(component))
        console.print(table, end="\n\n")
    for problem in catalog().problems:
        console.print(f"plugin {problem.plugin!r} was left out: {problem.reason}", markup=False)


@click.command()
@click.argument("recipe")
@click.argument("overrides", nargs=-1)
def show(recipe: str, overrides: tuple[str, ...]) -> None:
    """Print a recipe in full, after checking it.

    RECIPE is a file or the name of a recipe that comes with acwm. OVERRIDES change it, as in `acwm
    fit`: conditioner=cross_attention model.layers=4 trainer.devices=2. Every parameter is
    written out with its value, so the output is a recipe that stands on its own.
    """
    from acwm_core.recipe import compose

    click.echo(compose(recipe, overrides).to_yaml(), nl=False)


def _summary(component: Component) -> str:
    from rich.markup import escape

    missing = component.missing_modules()
    if not missing:
        return escape(component.summary)
    needs = f"needs {', '.join(missing)}: {component.install_command(missing[0])}"
    return f"{escape(component.summary)} [red]({escape(needs)})[/red]"
