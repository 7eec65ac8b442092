"""`acwm train-reward`: a reward of states or latents, from a recorded column."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import click

from acwm_core.cli.arguments import DATASET, OUT_FOLDER


@click.command()
@click.argument("data", type=DATASET)
@click.option(
    "--from",
    "column",
    required=True,
    metavar="COLUMN",
    help="Recorded column with the reward or the success of each frame, such as next.reward.",
)
@click.option(
    "--run",
    metavar="MODEL",
    help="Look at what this model predicts: its states, or else latents of its codec.",
)
@click.option(
    "--states",
    metavar="NAMES",
    default="",
    help="States to look at, separated by commas; by default all but outcomes such as success.",
)
@click.option("--latents", is_flag=True, help="Look at latents even if the model predicts states.")
@click.option("--steps", type=click.IntRange(1), default=2000, help="Optimiser steps.")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=0, help="Seed of the weights.")
@click.option(
    "--out", type=OUT_FOLDER, help="The head's folder; runs/rewards/ENVIRONMENT by default."
)
def train_reward(data: Path, column: str, states: str, out: Path | None, **options: Any) -> None:
    """Learn a reward from a recorded column, for plans and policies without a task.

    DATA must have a number for each frame: a state, or a fact of its episodes. A small network
    learns to predict it from the other states. The error is measured on the test episodes, or on
    others that are held out.
    """
    from acwm_core.data.card import DatasetCard
    from acwm_planning.rewards.training import train_reward as train

    name = DatasetCard.read(data).environment.name
    where = out or Path("runs/rewards") / name
    names = [field.strip() for field in states.split(",") if field.strip()]
    card = train(data, column, where, states=names, progress=True, **options).card
    seen = ", ".join(field.name for field in card.state) or "latents"
    click.echo(f"{where}: {card.column}, {card.worst:g} to {card.best:g}, from {seen}")
    click.echo(f"squared error: {card.held_out.text} (R² {1 - card.held_out.share:.2f})")
    if card.held_out.low is None:
        click.echo("fewer than five episodes are held out: too few for an interval")
    if card.state:
        click.echo(f"next: acwm policy train {name} MODEL --reward {shlex.quote(str(where))}")
    click.echo(f"next: acwm plan MODEL TASK cost=reward {shlex.quote(f'cost.head={where}')}")
