"""`acwm encode`: the clips of a dataset as latents, once, for all trainings with that codec."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import click

from acwm_core.cli.folders import DATASET
from acwm_core.errors import DataError, RecipeError


@click.command()
@click.argument("data", type=DATASET)
@click.argument("overrides", nargs=-1)
@click.option("--codec", "name", required=True, help="Name of the codec: `acwm list codec`.")
@click.option(
    "--split", default="train", show_default=True, help="train, ind_test, ood_test or all."
)
@click.option("--frames", type=click.IntRange(2), default=37, show_default=True, help="Of a clip.")
@click.option(
    "--stride",
    type=click.IntRange(1),
    default=4,
    show_default=True,
    help="Frames between the starts of an episode's clips.",
)
@click.option(
    "--batch-size",
    type=click.IntRange(1),
    default=8,
    show_default=True,
    help="Clips encoded at once.",
)
@click.option("--device", help="cpu, cuda, cuda:1, …; the first GPU by default, if there is one.")
@click.option("--skip-damaged", is_flag=True, help="Leave out episodes of damaged shards.")
def encode(
    data: Path,
    overrides: tuple[str, ...],
    name: str,
    split: str,
    frames: int,
    stride: int,
    batch_size: int,
    device: str | None,
    skip_damaged: bool,
) -> None:
    """Encode the clips of DATA with a codec.

    The latents are kept beside the clips, in DATA/latents, where `acwm fit` with the same codec,
    data.clip_frames (--frames) and data.window_stride (--stride) finds them; without this command
    it makes them itself. OVERRIDES set the codec's parameters: codec.weights=random.

    Interrupted, the same command goes on where it stopped. Several at once, also on machines that
    share the folder, divide the work.
    """
    parameters = _parameters(name, overrides)

    from acwm_core.assembly import build_codec
    from acwm_core.data.card import DatasetCard
    from acwm_core.data.encoding import encode_windows
    from acwm_core.data.episodes import EpisodeDataset
    from acwm_core.recipe import ComponentConfig

    known = list(DatasetCard.read(data).splits)
    if split != "all" and split not in known:
        raise DataError(f"{data} has no split {split!r}, only {', '.join(known)} (or all)")
    codec = build_codec(ComponentConfig(name, parameters)).to(_device(device))
    for chosen in known:
        if split not in ("all", chosen):
            continue
        folder = encode_windows(
            EpisodeDataset(data, chosen),
            codec,
            frames=frames,
            stride=stride,
            batch_size=batch_size,
            skip_damaged=skip_damaged,
        )
        click.echo(f"{folder} holds the latents of {chosen}")


def _parameters(name: str, overrides: Sequence[str]) -> dict[str, object]:
    """The codec's parameters, checked before torch is imported."""
    from acwm_core.recipe.compose import merge, parse_override
    from acwm_core.recipe.validate import check_component

    choice: dict[str, object] = {"codec": {"name": name}}
    for override in overrides:
        if not override.startswith("codec."):
            raise RecipeError(f"{override!r} sets nothing of the codec; write codec.NAME=VALUE")
        choice = merge(choice, parse_override(override))
    checked = check_component("codec", choice["codec"])
    return {key: value for key, value in checked.items() if key != "name"}


def _device(name: str | None) -> str:
    """The device of that name, or the best one.

    Raises:
        DataError: this machine has none of that name.
    """
    import torch

    if name is None:
        return "cuda" if torch.cuda.is_available() else "cpu"
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise DataError(f"--device {name} cannot be used here ({reason})") from error
    return name
