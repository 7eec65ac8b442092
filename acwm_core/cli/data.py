"""`acwm data`: a look into datasets, and their way in and out."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import click

from acwm_core.cli.exchange import export, import_group
from acwm_core.cli.folders import DATASET, OUT_FOLDER


@click.group()
def data() -> None:
    """Look into datasets, and bring them in and out."""


@data.command()
@click.argument("path", type=DATASET)
@click.option("--json", "as_json", is_flag=True, help="Print everything as JSON.")
def info(path: Path, as_json: bool) -> None:
    """Say what the dataset PATH holds, also while it is being made."""
    from acwm_core.data.preview import describe

    facts = describe(path)
    if as_json:
        click.echo(json.dumps(facts, indent=2, ensure_ascii=False))
    else:
        _print_facts(facts)


@data.command()
@click.argument("path", type=DATASET)
@click.option("--out", type=OUT_FOLDER, help="Folder; PATH/preview by default.")
@click.option(
    "--episodes",
    type=click.IntRange(1),
    default=4,
    show_default=True,
    help="How many of each split.",
)
def preview(path: Path, out: Path | None, episodes: int) -> None:
    """Draw the first episodes of the dataset PATH as a picture and a film."""
    from acwm_core.data.preview import preview as draw

    for file in draw(path, out or path / "preview", episodes=episodes):
        click.echo(file)


@data.command()
@click.argument("path", type=DATASET)
@click.option(
    "--replays",
    type=click.IntRange(0),
    default=2,
    show_default=True,
    help="How many episodes of each split to simulate again.",
)
def check(path: Path, replays: int) -> None:
    """Verify the dataset PATH: checksums, contents, and that the simulator makes the same.

    Exit code 1 if something is wrong.
    """
    from acwm_core.data.check import check_dataset

    failed = 0
    for finding in check_dataset(path, replays=replays):
        failed += finding.problem is not None
        click.echo(finding)
    if failed:
        click.echo(f"{failed} failed", err=True)
        sys.exit(1)


def _print_facts(facts: dict[str, Any]) -> None:
    from rich.console import Console
    from rich.table import Table

    height, width = facts["frame_size"]
    click.echo(f"{facts['path']}: {facts['environment']}, {facts['summary']}")
    click.echo(f"{height}×{width} at {facts['fps']} fps, {facts['horizon']} frames per episode")
    if facts["source"]:
        click.echo(f"recorded: {facts['source']['name']} ({facts['source']['kind']})")
        for note in facts["source"].get("notes", ()):
            click.echo(f"  {note}")
    else:
        click.echo(f"seed {facts['seed']}, factors {facts['factors'] or 'as the splits say'}")
    table = Table(box=None)
    for column in ("split", "episodes", "made", "shards", "frames", "MB"):
        table.add_column(column, justify="left" if column == "split" else "right")
    for split, each in facts["splits"].items():
        counts = [str(each[name]) for name in ("episodes", "made", "shards", "frames")]
        table.add_row(split, *counts, f"{each['bytes'] / 1e6:.1f}")
    Console(highlight=False).print(table)
    for split, each in facts["splits"].items():
        for label, count in each.get("ood_labels", {}).items():
            click.echo(f"{split}: {count} episodes shift {label}")


data.add_command(import_group)
data.add_command(export)
