"""`acwm generate` and `acwm encode`: a dataset from a simulator, and its clips as latents."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from acwm_core.cli.arguments import DATASET, OUT_FOLDER, renamed_option, size
from acwm_core.cli.components import split_parameters
from acwm_core.errors import DataError, RecipeError

if TYPE_CHECKING:
    from acwm_core.episode import FactorSetting


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
@click.option("--workers", type=int, help="Parallel workers; one per core by default, 0 for none.")
@click.option(
    "--executor",
    default="processes",
    help="processes (this machine) or another name from `acwm list executor`.",
)
@renamed_option("--ray-address", "executor.address")
@renamed_option("--sbatch", "executor.sbatch")
def generate(
    environment: str,
    overrides: tuple[str, ...],
    out: Path | None,
    split: str,
    episodes: str | None,
    workers: int | None,
    executor: str,
    ray_address: str | None,
    sbatch: str | None,
    **seed_and_size: Any,
) -> None:
    """Simulate a dataset of ENVIRONMENT.

    OVERRIDES set factors of variation in all episodes, factors.friction=ood (or train, nominal, or
    a value), and options of the executor, executor.sbatch='--partition=cpu'. The card.yaml of a
    dataset lists the factors and their ranges.

    The same arguments give the same bytes, for any number of workers. If it is interrupted, run
    the same command again to continue. Another split is added to the folder.
    """
    from acwm_core.catalog import catalog
    from acwm_core.data.generate import generate as generate_dataset
    from acwm_core.data.generate import parse_episodes
    from acwm_core.data.simulate import make_environment
    from acwm_core.executors import create_executor, split_options

    out = out or Path("data", environment)
    others, options = split_options(overrides)
    old = {"address": ray_address, "sbatch": sbatch}
    options |= {name: value for name, value in old.items() if value}
    chosen = create_executor(executor, out / ".executor", workers, options)
    simulator = make_environment(catalog().component("environment", environment), {})
    counts = parse_episodes(episodes, simulator.card, split)
    simulator.close()
    factors = _factors(others)
    card = generate_dataset(
        environment, out, episodes=counts, factors=factors, executor=chosen, **seed_and_size
    )
    made = ", ".join(f"{count} {name}" for name, count in card.splits.items())
    click.echo(f"{out} holds {made} episodes of {environment}")


def _factors(overrides: Sequence[str]) -> dict[str, FactorSetting]:
    """The settings of ``factors.NAME=SETTING``; whether the environment has them is seen later."""
    from acwm_core.executors import split_options

    wrong, factors = split_options(overrides, "factors")
    values = factors.items()
    wrong += [f"factors.{name}={v}" for name, v in values if type(v) not in (int, float, str)]
    if wrong:
        raise RecipeError(
            f"{wrong[0]!r} sets no factor; write factors.NAME=SETTING with a number or a word"
        )
    return factors


@click.command()
@click.argument("data", type=DATASET)
@click.argument("overrides", nargs=-1)
@click.option("--codec", "name", required=True, help="Name of the codec: `acwm list codec`.")
@click.option("--split", default="train", help="train, ind_test, ood_test or all.")
@click.option("--frames", type=click.IntRange(2), default=37, help="Frames per clip.")
@click.option(
    "--stride",
    type=click.IntRange(1),
    default=4,
    help="Frames between starts of an episode's clips.",
)
@click.option("--batch-size", type=click.IntRange(1), default=8, help="Clips per batch.")
@click.option(
    "--device", default="auto", help="cpu, cuda, cuda:1, …; auto is a GPU if there is one."
)
@click.option("--skip-damaged", is_flag=True, help="Skip episodes of damaged shards.")
def encode(
    data: Path,
    overrides: tuple[str, ...],
    name: str,
    split: str,
    device: str,
    **windows: Any,
) -> None:
    """Encode the clips of a dataset as latents.

    Latents go to DATA/latents. `acwm fit` uses them if codec, data.clip_frames (--frames) and
    data.window_stride (--stride) are the same, and encodes missing ones itself. OVERRIDES set
    the codec's parameters: codec.weights=random.

    If it is interrupted, run the same command again to continue. Several commands share the work,
    also on several machines with a shared folder.
    """
    others, parameters = split_parameters("codec", name, overrides)
    if others:
        raise RecipeError(f"{others[0]!r} sets no parameter of the codec; write codec.NAME=VALUE")

    from acwm_core.assembly import build_codec
    from acwm_core.data.card import DatasetCard
    from acwm_core.data.encoding import encode_windows
    from acwm_core.data.episodes import EpisodeDataset
    from acwm_core.evaluation.evaluate import choose_device
    from acwm_core.recipe import ComponentConfig

    known = list(DatasetCard.read(data).splits)
    if split != "all" and split not in known:
        raise DataError(f"{data} has no split {split!r}, only {', '.join(known)} (or all)")
    codec = build_codec(ComponentConfig(name, parameters)).to(choose_device(device, "--device "))
    for chosen in known if split == "all" else (split,):
        folder = encode_windows(EpisodeDataset(data, chosen), codec, **windows)
        click.echo(f"{folder} holds the latents of {chosen}")
