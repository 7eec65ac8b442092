"""`acwm train-codec`: train a codec, or its decoder, on your own data."""

from __future__ import annotations

from pathlib import Path

import click

from acwm_core.cli.arguments import DATASET, OUT_FILE, RUN


@click.command("train-codec")
@click.argument("data", nargs=-1, required=True, type=DATASET)
@click.option("--out", type=OUT_FILE, required=True, help="Output .safetensors.")
@click.option(
    "--codec",
    default="compact",
    type=click.Choice(["compact", "fine", "compact_reference"]),
    help="Which codec.  [default: compact]",
)
@click.option(
    "--start",
    help="Initial weights: a file, random, or the codec's name, for those that ship (default).",
)
@click.option("--decoder-only", is_flag=True, help="Keep the encoder, and so the latents.")
@click.option(
    "--predicted-by",
    type=RUN,
    multiple=True,
    metavar="RUN",
    help="Also train the decoder on this model's predictions of DATA; repeat for models "
    "of several worlds.",
)
@click.option(
    "--freeze-coarse",
    is_flag=True,
    help="Train only the finer layers of the decoder of compact_reference: OUT has 3 MB, not 7.",
)
@click.option("--steps", default=2000, type=click.IntRange(1), help="Optimiser steps.")
@click.option("--batch", default=32, type=click.IntRange(1), help="Groups of frames per step.")
@click.option(
    "--peak",
    default=3e-4,
    type=click.FloatRange(0, 1, min_open=True),
    help="Peak learning rate; use 1e-3 for random weights.",
)
@click.option(
    "--decay",
    default=1.0,
    type=click.FloatRange(0, 1),
    help="Share of the steps with learning-rate decay to zero.",
)
@click.option("--episodes", default=300, type=click.IntRange(1), help="Episodes of each dataset.")
@click.option("--seed", default=0, type=click.IntRange(0), help="Random seed.")
@click.option(
    "--threads", default=0, type=click.IntRange(0), help="CPU threads; 0 leaves PyTorch's choice."
)
def train_codec(
    data: tuple[Path, ...], out: Path, codec: str, start: str | None, **options: object
) -> None:
    """Train a codec on the training episodes of DATA.

    A folder that is named twice counts twice. Starts from the weights that ship and prints the gain
    on test episodes. If it is interrupted, run the same command again to continue. Use the result
    in a recipe with codec.weights=FILE.
    """
    from acwm_codecs.train_codec import train_on

    train_on(data, out, codec=codec, start=start or codec, **options)  # pyright: ignore[reportArgumentType]
