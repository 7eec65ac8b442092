"""`acwm generate`: a dataset from a simulator, on this machine or on a cluster."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.folders import OUT_FOLDER
from acwm_core.cli.size import SIZE
from acwm_core.errors import RecipeError, with_new_names
from acwm_core.recipe.text import parse

if TYPE_CHECKING:
    from acwm_core.episode import FactorSetting

RENAMED = {"--ray-address": "executor.address", "--sbatch": "executor.sbatch"}
"""Old options by what they became."""


@click.command()
@click.argument("environment")
@click.argument("overrides", nargs=-1)
@click.option("--out", type=OUT_FOLDER, help="Folder; data/ENVIRONMENT by default.")
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
@click.option("--workers", type=int, help="How many at once; one per core by default, 0 for none.")
@click.option(
    "--executor",
    default="processes",
    show_default=True,
    help="Where: processes of this machine, or another name of `acwm list executor`.",
)
@click.option("--ray-address", hidden=True, help="Now executor.address=…")
@click.option("--sbatch", hidden=True, help="Now executor.sbatch=…")
def generate(
    environment: str,
    overrides: tuple[str, ...],
    out: Path | None,
    split: str,
    episodes: str | None,
    size: int | tuple[int, int] | None,
    seed: int,
    workers: int | None,
    executor: str,
    ray_address: str | None,
    sbatch: str | None,
) -> None:
    """Simulate a dataset of ENVIRONMENT.

    OVERRIDES set factors of variation in every episode: factors.friction=ood (or train,
    nominal, or a value), and options of the executor: executor.sbatch='--partition=cpu'. The
    card.yaml of a dataset lists the factors and their ranges.

    The same arguments make the same bytes, wherever and by however many workers. Interrupted, the
    same command resumes where it stopped; for another split it adds to the folder.
    """
    from acwm_core.catalog import catalog
    from acwm_core.data.generate import generate as generate_dataset
    from acwm_core.data.generate import parse_episodes
    from acwm_core.data.simulate import make_environment
    from acwm_core.executors import create_executor, split_options

    out = out or Path("data", environment)
    factors, options = split_options(overrides)
    old = {"--ray-address": ray_address, "--sbatch": sbatch}
    given = {name: value for name, value in old.items() if value}
    for name, value in with_new_names(given, RENAMED).items():
        options[name.removeprefix("executor.")] = value
    chosen = create_executor(executor, out / ".executor", workers, options)
    simulator = make_environment(catalog().component("environment", environment), {})
    counts = parse_episodes(episodes, simulator.card, split)
    simulator.close()
    card = generate_dataset(
        environment,
        out,
        episodes=counts,
        seed=seed,
        size=size,
        factors=_factors(factors),
        executor=chosen,
    )
    made = ", ".join(f"{count} {name}" for name, count in card.splits.items())
    click.echo(f"{out} holds {made} episodes of {environment}")


def _factors(overrides: Sequence[str]) -> dict[str, FactorSetting]:
    """The settings of ``factors.NAME=SETTING``; whether the environment has them is seen later."""
    factors: dict[str, FactorSetting] = {}
    for override in overrides:
        name, equals, text = override.removeprefix("factors.").partition("=")
        value = parse(text, f"the value of {override!r}")
        number_or_word = isinstance(value, (int, float, str)) and not isinstance(value, bool)
        if not override.startswith("factors.") or not name or not equals or not number_or_word:
            raise RecipeError(
                f"{override!r} sets no factor; write factors.NAME=SETTING with a number or a word"
            )
        factors[name] = value
    return factors
