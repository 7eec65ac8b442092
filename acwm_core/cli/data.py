"""`acwm generate` and `acwm data`: datasets from a simulator, and a look into them."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from acwm_core.cli.exchange import export, import_group
from acwm_core.cli.folders import DATASET, FOLDER
from acwm_core.cli.size import SIZE
from acwm_core.errors import RecipeError
from acwm_core.recipe.text import parse

if TYPE_CHECKING:
    from acwm_core.episode import FactorSetting


@click.command()
@click.argument("environment")
@click.argument("words", nargs=-1)
@click.option("--out", type=FOLDER, help="Folder; data/ENVIRONMENT by default.")
@click.option("--split", default="all", help="train, ind_test, ood_test or all (the default).")
@click.option(
    "--episodes",
    help="How many: 1000, or 1000,100,100 for train, ind_test and ood_test. By default the full "
    "benchmark.",
)
@click.option(
    "--size", type=SIZE, help="Frame size, 64 or HEIGHTxWIDTH; by default the environment's."
)
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the dataset.")
@click.option("--workers", type=int, help="Processes; one per core by default, 0 for none.")
def generate(
    environment: str,
    words: tuple[str, ...],
    out: Path | None,
    split: str,
    episodes: str | None,
    size: int | tuple[int, int] | None,
    seed: int,
    workers: int | None,
) -> None:
    """Simulate a dataset of ENVIRONMENT.

    WORDS override factors of variation in every episode: factors.friction=ood (or train, nominal,
    or a value). The card.yaml of a dataset lists the factors and their ranges.

    The same arguments make the same bytes, whatever the number of workers. Interrupted, the same
    command goes on where it stopped; for another split it adds to the folder.
    """
    from acwm_core.catalog import catalog
    from acwm_core.data.generate import generate as generate_dataset
    from acwm_core.data.generate import parse_episodes
    from acwm_core.data.simulate import make_environment

    out = out or Path("data", environment)
    simulator = make_environment(catalog().part("environment", environment), {})
    counts = parse_episodes(episodes, simulator.card, split)
    simulator.close()
    card = generate_dataset(
        environment,
        out,
        episodes=counts,
        seed=seed,
        size=size,
        factors=_factors(words),
        workers=workers,
    )
    made = ", ".join(f"{count} {name}" for name, count in card.splits.items())
    click.echo(f"{out} holds {made} episodes of {environment}")


@click.group()
def data() -> None:
    """Look into a dataset."""


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
@click.option("--out", type=FOLDER, help="Folder; PATH/preview by default.")
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


def _factors(words: tuple[str, ...]) -> dict[str, FactorSetting]:
    """The settings of ``factors.NAME=SETTING``; whether the environment has them is seen later."""
    factors: dict[str, FactorSetting] = {}
    for word in words:
        name, equals, text = word.removeprefix("factors.").partition("=")
        value = parse(text, f"the value of {word!r}")
        number_or_word = isinstance(value, (int, float, str)) and not isinstance(value, bool)
        if not word.startswith("factors.") or not name or not equals or not number_or_word:
            raise RecipeError(
                f"{word!r} sets no factor; write factors.NAME=SETTING with a number or a word"
            )
        factors[name] = value
    return factors


data.add_command(import_group)
data.add_command(export)
