"""`acwm encode`: encode the clips of a dataset as latents."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from acwm_core.cli.arguments import DATASET, split_parameters
from acwm_core.errors import DataError, RecipeError


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
@click.option(
    "--symmetries",
    is_flag=True,
    help="Also encode the clips as each symmetry on the data's card transforms them.",
)
@click.option("--batch-size", type=click.IntRange(1), default=8, help="Clips per batch.")
@click.option(
    "--device", default="auto", help="cpu, cuda, cuda:1, …; auto is a GPU if there is one."
)
def encode(
    data: Path,
    overrides: tuple[str, ...],
    name: str,
    split: str,
    symmetries: bool,
    device: str,
    **windows: Any,
) -> None:
    """Encode the clips of a dataset as latents.

    Latents go to DATA/latents. `acwm fit` uses them if codec, data.clip_frames (--frames),
    data.window_stride (--stride) and data.symmetries are the same, and encodes missing ones itself.
    OVERRIDES set the codec's parameters: codec.weights=random.

    If it is interrupted, run the same command again to continue. Several commands share the work,
    also on several machines with a shared folder.
    """
    others, parameters = split_parameters("codec", name, overrides)
    if others:
        raise RecipeError(f"{others[0]!r} sets no parameter of the codec; write codec.NAME=VALUE")

    from acwm_core.data.card import DatasetCard
    from acwm_core.data.dataset import EpisodeDataset, declared_symmetries
    from acwm_core.data.latents import encode_windows
    from acwm_core.evaluation.evaluate import choose_device
    from acwm_core.model.build import build_codec
    from acwm_core.recipe import ComponentConfig

    known = list(DatasetCard.read(data).splits)
    if split != "all" and split not in known:
        raise DataError(f"{data} has no split {split!r}, only {', '.join(known)} (or all)")
    codec = build_codec(ComponentConfig(name, parameters)).to(choose_device(device, "--device "))
    for chosen in known if split == "all" else (split,):
        episodes = EpisodeDataset(data, chosen)
        for symmetry in (None, *(declared_symmetries(episodes) if symmetries else ())):
            folder = encode_windows(episodes, codec, symmetry=symmetry, **windows)
            click.echo(f"{folder} holds the latents of {chosen}")
