"""`acwm generate`: a dataset from a simulator, on this machine or on a cluster."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.folders import OUT_FOLDER
from acwm_core.cli.size import SIZE
from acwm_core.errors import RecipeError
from acwm_core.recipe.text import parse

if TYPE_CHECKING:
    from acwm_core.data.executors import Executor
    from acwm_core.episode import FactorSetting


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
    type=click.Choice(["processes", "ray", "slurm"]),
    default="processes",
    show_default=True,
    help="Where: processes of this machine, a Ray cluster, or SLURM array jobs.",
)
@click.option("--ray-address", help="Of a running cluster: auto or HOST:PORT. Else Ray is started.")
@click.option(
    "--sbatch", default="", help="Options of SLURM's sbatch: '--partition=cpu --time=2:00:00'."
)
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
    sbatch: str,
) -> None:
    """Simulate a dataset of ENVIRONMENT.

    OVERRIDES set factors of variation in every episode: factors.friction=ood (or train,
    nominal, or a value). The card.yaml of a dataset lists the factors and their ranges.

    The same arguments make the same bytes, wherever and by however many workers. Interrupted, the
    same command goes on where it stopped; for another split it adds to the folder.
    """
    from acwm_core.catalog import catalog
    from acwm_core.data.generate import generate as generate_dataset
    from acwm_core.data.generate import parse_episodes
    from acwm_core.data.simulate import make_environment

    out = out or Path("data", environment)
    simulator = make_environment(catalog().component("environment", environment), {})
    counts = parse_episodes(episodes, simulator.card, split)
    simulator.close()
    card = generate_dataset(
        environment,
        out,
        episodes=counts,
        seed=seed,
        size=size,
        factors=_factors(overrides),
        executor=_executor(executor, workers, out, ray_address, sbatch),
    )
    made = ", ".join(f"{count} {name}" for name, count in card.splits.items())
    click.echo(f"{out} holds {made} episodes of {environment}")


def _executor(
    name: str, workers: int | None, out: Path, ray_address: str | None, sbatch: str
) -> Executor:
    for option, given, needs in (
        ("--ray-address", ray_address, "ray"),
        ("--sbatch", sbatch, "slurm"),
    ):
        if given and name != needs:
            raise RecipeError(f"{option} is for --executor {needs}, not {name}")
    if name == "ray":
        from acwm_core.data.ray_executor import RayExecutor

        return RayExecutor(ray_address, workers)
    if name == "slurm":
        from acwm_core.data.slurm_executor import SlurmExecutor

        return SlurmExecutor(out / ".slurm", sbatch, workers)
    from acwm_core.data.executors import make_executor

    return make_executor(workers)


def _factors(overrides: tuple[str, ...]) -> dict[str, FactorSetting]:
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
