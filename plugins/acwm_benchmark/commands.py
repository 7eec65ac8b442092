"""`acwm benchmark export` and `acwm score`."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import click

from acwm_core.cli.arguments import FOLDER, OUT_FOLDER, size


def _count(context: click.Context, option: click.Parameter, text: str | None) -> int | None:
    """Parse a number of episodes; 0 stands for ``all``."""
    if text in (None, "all"):
        return None if text is None else 0
    if not text.isdigit() or int(text) < 2:
        raise click.BadParameter(f"{text}: give a number from 2 on, or all")
    return int(text)


@click.group()
def benchmark() -> None:
    """Export the test clips as tasks that any program can enter."""


@benchmark.command("export")
@click.argument("words", nargs=-1, metavar="[WORLD]... [OVERRIDES]...")
@click.option("--out", type=OUT_FOLDER, default=Path("tasks"), help="A new folder.")
@click.option(
    "--data",
    type=FOLDER,
    help="Test data, or a folder with a dataset per world; by "
    "default it is simulated into OUT-truth.",
)
@click.option("--size", type=size, help="Frame size; by default the environment's.")
@click.option(
    "--episodes",
    callback=_count,
    help="Number of episodes of each test split, or all; the protocol's or 64 by default.",
)
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    help="Any but 0 makes a secret set: the tasks do not contain the seed.",
)
@click.option("--workers", type=int, help="Parallel workers; one per core by default, 0 for none.")
def export(words: tuple[str, ...], out: Path, **others: Any) -> None:
    """Write the tasks of WORLDs: first frames and actions, without the ground truth.

    The tasks are all test clips of both splits, and other actions from the same first frames.
    Without a WORLD, all datasets in --data, or else all environments. OVERRIDES set the evaluation:
    evaluation.context_frames=5, evaluation.protocol=acwm-phys.
    """
    from acwm_core.plugins import catalog

    worlds = [word for word in words if "=" not in word]
    if others["data"] is None:
        worlds = worlds or [component.name for component in catalog().registry("environment")]
        for world in worlds:
            catalog().component("environment", world)  # a misspelt one needs no torch
    overrides = [word for word in words if "=" in word]
    from acwm_benchmark.export import export_tasks

    made = export_tasks(worlds, out, overrides=overrides, **others)
    count = len(made.all)
    click.echo(
        f"{out} holds {count} task{'s' * (count != 1)} of {', '.join(made.benchmark.worlds)}"
    )


@click.command()
@click.argument("predictions", type=FOLDER)
@click.argument("worlds", nargs=-1, metavar="[WORLD]...")
@click.option("--tasks", type=FOLDER, required=True, help="The folder that was exported.")
@click.option(
    "--data",
    type=FOLDER,
    help="True test data, or a folder with a dataset per world; "
    "by default TASKS-truth, where it is simulated if it is missing.",
)
@click.option("--out", type=OUT_FOLDER, help="Folder; scores/NAME of PREDICTIONS by default.")
@click.option("--overwrite", is_flag=True, help="Replace results of other tasks or settings.")
@click.option(
    "--follow-links",
    is_flag=True,
    help="Let predictions be links that lead out of PREDICTIONS; for one's own, not for others'.",
)
@click.option("--workers", type=int, help="Parallel workers; one per core by default, 0 for none.")
def score(predictions: Path, worlds: tuple[str, ...], tasks: Path, **others: Any) -> None:
    """Score PREDICTIONS of tasks by any program.

    Measures everything that `acwm evaluate` measures without a network. Reports, comparisons and
    leaderboards accept OUT/WORLD like a run.
    """
    from acwm_benchmark.score import score_predictions
    from acwm_report.terminal import print_summary

    found = score_predictions(predictions, tasks, worlds, **others)
    for world, summary in found.items():
        click.echo(f"{world}:")
        print_summary(summary)
    where = others["out"] or f"scores/{predictions.resolve().name}"
    click.echo(f"next: acwm report {shlex.quote(f'{where}/{next(iter(found))}')}")
