"""`acwm evaluate`, `report` and `rollout`: how good a trained model is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.folders import DATASET, FOLDER, RUN

if TYPE_CHECKING:
    from acwm_core.evaluation.results import Estimate, Summary

ROWS = {
    "model": "model",
    "shuffled": "wrong actions",
    "copy": "first frame",
    "codec": "codec alone",
}
"""How the rows of an evaluation are called in the table."""


@click.command()
@click.argument("run", type=RUN)
@click.argument("words", nargs=-1)
@click.option("--data", type=DATASET, help="Dataset; the one it was trained on by default.")
@click.option(
    "--protocol",
    type=click.Choice(["full", "acwm-phys"]),
    help="Whole episodes, or windows as published; the recipe's by default.",
)
def evaluate(run: Path, words: tuple[str, ...], data: Path | None, protocol: str | None) -> None:
    """Score the model of RUN on test clips.

    In and out of distribution, beside three reference rows. Writes RUN/evaluation:
    episodes.parquet, summary.json and videos. WORDS change how: evaluation.steps=10
    evaluation.episodes=32.
    """
    from acwm_core.recipe import compose

    if protocol:
        words = (*words, f"evaluation.protocol={protocol}")
    if words:
        compose(run / "recipe.yaml", words)  # misspelt words are found before torch is imported

    from acwm_core.evaluation.evaluate import evaluate_run

    print_summary(evaluate_run(run, data=data, words=words))
    click.echo(f"next: acwm report {run}")


@click.command()
@click.argument("runs", type=RUN, nargs=-1, required=True, metavar="RUN...")
@click.option("--out", type=FOLDER, help="The .html to write; report.html in the first RUN.")
def report(runs: tuple[Path, ...], out: Path | None) -> None:
    """Write the report of evaluated runs.

    One HTML file with tables, curves and videos that needs nothing else. Several runs are compared
    with one another.
    """
    from acwm_core.report.page import write_report

    click.echo(write_report(runs, out))


@click.command()
@click.argument("run", type=RUN)
@click.option(
    "--out",
    type=FOLDER,
    help="The .mp4 to write, or a .png for a sheet of frames; RUN/rollout.mp4 by default.",
)
@click.option("--data", type=DATASET, help="Dataset; the one it was trained on by default.")
@click.option("--split", default="ind_test", show_default=True, help="Split of the episode.")
@click.option("--episode", default=0, show_default=True, help="Number of the episode.")
@click.option("--actions", type=FOLDER, help="A .npy file of raw actions [N, A] to use instead.")
@click.option("--image", type=FOLDER, help="A picture to start from instead.")
@click.option(
    "--mode",
    type=click.Choice(["whole", "windows", "stream"]),
    default="windows",
    show_default=True,
    help="All frames at once; clip by clip; or a few at a time, by a model that is causal.",
)
@click.option("--steps", type=click.IntRange(1), help="Sampling steps; the recipe's by default.")
@click.option("--seed", default=0, show_default=True, help="Of the sampling noise.")
def rollout(run: Path, out: Path | None, **options: object) -> None:
    """Predict one video with the model of RUN.

    It starts from the first frame of an episode and follows its actions, and the video shows
    truth | prediction | difference; with --actions or --image, the prediction alone.
    """
    from acwm_core.evaluation.rollout import rollout_run

    click.echo(rollout_run(run, out or run / "rollout.mp4", **options))  # pyright: ignore[reportArgumentType]


def print_summary(summary: Summary) -> None:
    """Print the table of an evaluation: a row per split and predictor, a column per metric."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None)
    for name in ("split", "clips", "predicted by"):
        table.add_column(name, no_wrap=True)
    for name, metric in summary.metrics.items():
        table.add_column(f"{name} {metric.unit}".strip(), justify="right", no_wrap=True)
    for split, result in summary.splits.items():
        for row, scores in result.scores.rows.items():
            values = [_format(scores[name], name == summary.headline) for name in summary.metrics]
            table.add_row(split, str(result.scores.clips), ROWS.get(row, row), *values)
    Console(highlight=False).print(table)
    click.echo("± is half the 95 % interval over episodes; `wrong actions` are another episode's")
    for name, reason in summary.left_out.items():
        click.echo(f"{name} is left out: {reason}")
    for split, result in summary.splits.items():
        if result.steps:
            scores = (
                f"{point.steps}: {_format(point.scores[summary.headline], False)}"
                for point in result.steps.points
            )
            about = f"{split} {summary.headline} of {result.steps.clips} clips by sampling steps"
            click.echo(f"{about}  {'  '.join(scores)}")


def _format(estimate: Estimate, with_interval: bool) -> str:
    if estimate.value is None:
        return "–"
    text = f"{estimate.value:.4g}"
    if with_interval and estimate.low is not None and estimate.high is not None:
        text += f" ±{(estimate.high - estimate.low) / 2:.1g}"
    return text
