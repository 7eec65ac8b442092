"""The scores of an evaluation on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from acwm_core.cli.numbers import estimate_text
from acwm_core.cli.simulated import print_simulated

if TYPE_CHECKING:
    from rich.table import Table

    from acwm_core.evaluation.benchmark import PublishedRow
    from acwm_core.evaluation.results import Summary

ROWS = {
    "model": "model",
    "shuffled": "wrong actions",
    "copy": "first frame",
    "codec": "codec alone",
    "truth": "noise floor",
    "perturbed": "other start",
}
"""What made a prediction, as the tables call it."""


def print_summary(summary: Summary) -> None:
    """Print the scores of every split, the steps curve, and the published scores beside ours."""
    from rich.console import Console

    from acwm_core.evaluation.benchmark import about_published

    console = Console(highlight=False)
    for split in summary.splits:
        console.print(_split_table(summary, split))
    click.echo("± is half the 95 % interval over episodes; `wrong actions` are another episode's")
    reasons: dict[str, list[str]] = {}
    for name, reason in summary.left_out.items():
        reasons.setdefault(reason, []).append(name)
    for reason, names in reasons.items():
        click.echo(f"left out: {', '.join(names)}: {reason}")
    _print_steps(summary)
    print_simulated(summary)
    if summary.published:
        console.print(_published_table(summary, summary.published.row))
        click.echo(about_published(summary))


def _split_table(summary: Summary, split: str) -> Table:
    """A line per metric, a column per predictor."""
    from rich.table import Table

    scores = summary.splits[split].scores
    clips = f"{scores.clips} clips"
    if scores.episodes != scores.clips:
        clips += f" of {scores.episodes} episodes"
    table = Table(box=None, title=f"{split}: {clips}", title_justify="left", title_style="bold")
    table.add_column("", no_wrap=True)
    for row in scores.rows:
        table.add_column(ROWS.get(row, row), justify="right")
    for name, metric in summary.metrics.items():
        shown = [
            estimate_text(values[name], interval=row == "model" and name == summary.headline)
            for row, values in scores.rows.items()
        ]
        table.add_row(f"{name} {metric.unit}".strip(), *shown)
    return table


def _print_steps(summary: Summary) -> None:
    for split, result in summary.splits.items():
        if result.steps:
            scores = (
                f"{point.steps}: {estimate_text(point.scores[summary.headline], interval=False)}"
                for point in result.steps.points
            )
            about = f"{split} {summary.headline} of {result.steps.clips} clips by sampling steps"
            click.echo(f"{about}  {'  '.join(scores)}")


def _published_table(summary: Summary, row: PublishedRow) -> Table:
    """The run's scores as they are published of others, above the published ones."""
    from rich.table import Table

    from acwm_core.report.score_tables import (
        CAPTION,
        ScoreGrid,
        compared_metrics,
        model_scores,
        published_scores,
    )

    quoted = " ".join(["published:", row.row, row.column]).strip()
    models = {summary.run: model_scores(summary), quoted: published_scores(row)}
    grid = ScoreGrid.of(list(models.values()), compared_metrics([summary]))
    table = Table(box=None, title=CAPTION, title_justify="left")
    table.add_column("")
    for column in grid.columns():
        head = f"{column.group}\n{column.title} {column.unit}".rstrip()
        table.add_column(head, justify="right", no_wrap=True)
    for name, scores in models.items():
        table.add_row(name, *(cell.text + "▼" * cell.worse for cell in grid.cells(scores)))
    return table
