"""`acwm train-codec`: the codec `compact`, trained on data of one's own."""

from __future__ import annotations

from pathlib import Path

import click

from acwm_core.cli.arguments import DATASET, OUT_FILE


@click.command("train-codec")
@click.argument("data", nargs=-1, required=True, type=DATASET)
@click.option("--out", type=OUT_FILE, required=True, help="The .safetensors to write.")
@click.option(
    "--start",
    default="compact",
    help="Weights to begin with: a file, compact for those that ship, or random for none.",
)
@click.option("--decoder-only", is_flag=True, help="Leave the encoder, and so the latents, alone.")
@click.option("--steps", default=2000, type=click.IntRange(1), help="Optimiser steps.")
@click.option("--batch", default=32, type=click.IntRange(1), help="Groups of frames per step.")
@click.option("--peak", default=3e-4, help="Peak learning rate; 1e-3 suits random weights.")
@click.option("--decay", default=1.0, help="Share of the steps in which the rate falls to zero.")
@click.option("--episodes", default=300, type=click.IntRange(1), help="Episodes of each dataset.")
@click.option("--seed", default=0, help="Of what is drawn.")
@click.option("--threads", default=0, help="CPU threads; 0 leaves PyTorch's choice.")
def train_codec(data: tuple[Path, ...], out: Path, **options: object) -> None:
    """Train the codec compact on the training episodes of DATA.

    It starts from the weights that ship, for worlds that these draw badly, and says what that
    gains on test episodes. A recipe takes the result by codec.weights=FILE.
    """
    from acwm_codecs.train_compact import train_on

    train_on(data, out, **options)  # pyright: ignore[reportArgumentType]
