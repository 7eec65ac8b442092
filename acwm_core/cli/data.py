"""`acwm generate` and `acwm data`: datasets from a simulator, and a look into them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.errors import RecipeError
from acwm_core.recipe import parse_word

if TYPE_CHECKING:
    from acwm_core.episode import FactorSetting


@click.command()
@click.argument("environment")
@click.argument("words", nargs=-1)
@click.option("--out", type=click.Path(path_type=Path), help="Folder; data/ENVIRONMENT by default.")
@click.option("--split", default="all", help="train, ind_test, ood_test or all (the default).")
@click.option(
    "--episodes",
    help="How many: 1000, or 1000,100,100 for train, ind_test and ood_test. By default the full "
    "benchmark.",
)
@click.option("--size", help="Frame size, 64 or HEIGHTxWIDTH; by default the environment's.")
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of the dataset.")
@click.option("--workers", type=int, help="Processes; one per core by default, 0 for none.")
def generate(
    environment: str,
    words: tuple[str, ...],
    out: Path | None,
    split: str,
    episodes: str | None,
    size: str | None,
    seed: int,
    workers: int | None,
) -> None:
    """Simulate episodes of ENVIRONMENT into a dataset.

    WORDS override factors of variation in every episode: factors.friction=ood (or train, nominal,
    or a value; the report of `acwm check ENVIRONMENT` lists the factors).

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
        size=_size(size),
        factors=_factors(words),
        workers=workers,
    )
    made = ", ".join(f"{count} {name}" for name, count in card.splits.items())
    click.echo(f"{out} holds {made} episodes of {environment}")


@click.group()
def data() -> None:
    """Look into a dataset."""


def _factors(words: tuple[str, ...]) -> dict[str, FactorSetting]:
    factors: dict[str, FactorSetting] = {}
    for word in words:
        match parse_word(word):
            case {"factors": {**settings}}:
                factors |= settings
            case _:
                raise RecipeError(f"{word!r} sets no factor; write factors.NAME=SETTING")
    return factors


def _size(text: str | None) -> int | tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d+)(?:[x×](\d+))?", text)
    if match is None:
        raise RecipeError(f"--size {text}: give a side such as 64, or HEIGHTxWIDTH such as 64x96")
    height, width = match.groups()
    return (int(height), int(width)) if width else int(height)
