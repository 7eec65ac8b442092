"""`acwm generate`: a dataset from a simulator."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from acwm_core.cli.arguments import OUT_FOLDER, size, split_options
from acwm_core.errors import RecipeError

if TYPE_CHECKING:
    from acwm_core.env.episode import FactorSetting


@click.command()
@click.argument("environment")
@click.argument("overrides", nargs=-1)
@click.option("--out", type=OUT_FOLDER, help="Folder; data/ENVIRONMENT by default.")
@click.option("--split", default="all", help="train, ind_test, ood_test or all.")
@click.option(
    "--episodes",
    help="Number of episodes: 1000, or 1000,100,100 for train, ind_test and ood_test. "
    "By default the full benchmark.",
)
@click.option(
    "--size", type=size, help="Frame size, 64 or HEIGHTxWIDTH; by default the environment's."
)
@click.option("--seed", type=int, default=0, help="Seed of the dataset.")
@click.option(
    "--exploration",
    type=float,
    default=0.0,
    help="Share of the training episodes, 0 to 1, that reuse the previous episode's actions.",
)
@click.option(
    "--shift",
    type=float,
    default=0.0,
    help="Shift one dimension of those actions by up to this share, 0 to 1, of half its range.",
)
@click.option("--workers", type=int, help="Parallel workers; one per core by default, 0 for none.")
@click.option(
    "--executor",
    default="processes",
    help="processes (this machine) or another name from `acwm list executor`.",
)
def generate(
    environment: str,
    overrides: tuple[str, ...],
    out: Path | None,
    split: str,
    episodes: str | None,
    workers: int | None,
    executor: str,
    **others_of_data: Any,
) -> None:
    """Simulate a dataset of ENVIRONMENT.

    OVERRIDES set factors of variation in all episodes, factors.friction=ood (or train, nominal, or
    a value), and options of the executor, executor.sbatch='--partition=cpu'. The card.yaml of a
    dataset lists the factors and their ranges.

    The same arguments give the same bytes, for any number of workers. If it is interrupted, run
    the same command again to continue. Another split is added to the folder.
    """
    from acwm_core.data.generate import generate as generate_dataset
    from acwm_core.data.generate import parse_episodes
    from acwm_core.data.simulate import make_environment
    from acwm_core.executors import create_executor
    from acwm_core.plugins import catalog

    out = out or Path("data", environment)
    others, options = split_options(overrides)
    chosen = create_executor(executor, out / ".executor", workers, options)
    simulator = make_environment(catalog().component("environment", environment), {})
    counts = parse_episodes(episodes, simulator.card, split)
    simulator.close()
    factors = _factors(others)
    card = generate_dataset(
        environment, out, episodes=counts, factors=factors, executor=chosen, **others_of_data
    )
    splits = ", ".join(f"{count} {name}" for name, count in card.splits.items())
    click.echo(f"{out} holds {splits} episodes of {environment}")


def _factors(overrides: Sequence[str]) -> dict[str, FactorSetting]:
    """Parse ``factors.NAME=SETTING``; that the environment has these factors is checked later."""
    wrong, factors = split_options(overrides, "factors")
    values = factors.items()
    wrong += [f"factors.{name}={v}" for name, v in values if type(v) not in (int, float, str)]
    if wrong:
        raise RecipeError(
            f"{wrong[0]!r} sets no factor; write factors.NAME=SETTING with a number or a word"
        )
    return factors
