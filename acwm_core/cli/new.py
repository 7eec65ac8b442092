"""`acwm new`: start a plugin of one's own."""

from __future__ import annotations

from pathlib import Path

import click

from acwm_core.cli.folders import OUT_FOLDER


@click.group()
def new() -> None:
    """Start a plugin of your own."""


@new.command()
@click.argument("name")
@click.option("--out", type=OUT_FOLDER, help="Folder to make; acwm_NAME by default.")
def environment(name: str, out: Path | None) -> None:
    """Write an installable package with an environment called NAME.

    It works as it is, a pendulum under your name; change it piece by piece.
    """
    from acwm_core.scaffold import scaffold_environment

    folder = scaffold_environment(name, out)
    click.echo(f"made {folder}; next: pip install -e {folder} && acwm check {name}")
