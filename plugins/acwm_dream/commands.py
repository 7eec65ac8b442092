"""`acwm rollout`: one prediction of a trained model as a video."""

from __future__ import annotations

from pathlib import Path

import click

from acwm_core.cli.arguments import DATASET, FOLDER, OUT_FILE, RUN


@click.command()
@click.argument("run", type=RUN)
@click.option(
    "--out",
    type=OUT_FILE,
    help="Output .mp4, or .png for a sheet of frames; RUN/rollout.mp4 by default.",
)
@click.option("--data", type=DATASET, help="Dataset; the one it was trained on by default.")
@click.option("--split", default="ind_test", help="Split of the episode.")
@click.option("--episode", default=0, help="Number of the episode.")
@click.option("--actions", type=FOLDER, help="A .npy file with raw actions [N, A] to use instead.")
@click.option("--image", type=FOLDER, help="A picture to start from instead.")
@click.option(
    "--mode",
    type=click.Choice(["whole", "windows", "stream"]),
    help="All frames at once; clip by clip; or a few at a time, keeping the model's state. By "
    "default the mode that the model was trained for.",
)
@click.option("--steps", type=click.IntRange(1), help="Sampling steps; the recipe's by default.")
@click.option(
    "--seed", default=0, type=click.IntRange(0, 2**63 - 1), help="Seed of the sampling noise."
)
@click.option(
    "--samples",
    default=1,
    type=click.IntRange(1),
    help="Number of draws of a stochastic model to show side by side.",
)
def rollout(run: Path, out: Path | None, **options: object) -> None:
    """Predict one video with the model of RUN.

    Starts from the first frame of an episode and uses its actions. The video shows truth |
    prediction | difference, or only the prediction with --actions or --image. With --samples, the
    truth and several samples are side by side.
    """
    from acwm_dream.rollout import rollout_run

    click.echo(rollout_run(run, out or run / "rollout.mp4", **options))  # pyright: ignore[reportArgumentType]
