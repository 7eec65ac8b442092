"""`acwm train-estimator`: an estimator of one's own world, from its masks and states."""

from __future__ import annotations

import shlex
from pathlib import Path

import click

from acwm_core.cli.arguments import DATASET, OUT_FILE
from acwm_core.errors import RecipeError


def _turns(
    context: click.Context, option: click.Parameter, given: tuple[str, ...]
) -> dict[str, int]:
    """Parse ``FIELD`` or ``FIELD:TURNS``."""
    angles: dict[str, int] = {}
    for text in given:
        name, _, turns = text.partition(":")
        if not turns.isdecimal() and turns:
            raise RecipeError(f"--angle {text}: write FIELD:TURNS, as in cube_yaw:4")
        angles[name] = max(1, int(turns or 1))
    return angles


@click.command()
@click.argument("data", type=DATASET)
@click.option("--out", type=OUT_FILE, required=True, help="Weights to write, *.safetensors.")
@click.option(
    "--angle",
    "angles",
    multiple=True,
    callback=_turns,
    help="A state in rad to read as well, FIELD, or FIELD:4 if quarter turns look the same.",
)
@click.option("--steps", type=click.IntRange(1), default=1200, help="Optimiser steps.")
@click.option("--episodes", type=click.IntRange(1), default=200, help="Episodes to train on.")
@click.option("--seed", type=int, default=0, help="Seed of the weights and of the frames.")
def train_estimator(
    data: Path, out: Path, angles: dict[str, int], steps: int, episodes: int, seed: int
) -> None:
    """Train a network that reads the states of your own world.

    DATA needs masks that name instances, and positions among its states. The command matches
    positions to instances, uses the camera that the card declares, or else fits one, and at the end
    prints the errors on other episodes; `acwm new estimator NAME --weights FILE` makes a package of
    it.
    """
    from acwm_estimators.train_fitted import train_fitted  # imports torch

    for line in train_fitted(data, out, angles, steps=steps, episodes=episodes, seed=seed):
        click.echo(line)
    click.echo(f"wrote {out}; next: acwm new estimator NAME --weights {shlex.quote(str(out))}")
