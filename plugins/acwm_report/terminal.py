"""Print the scores of an evaluation as tables in the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from acwm_core.cli.tables import plain_table

if TYPE_CHECKING:
    from rich.table import Table

    from acwm_core.evaluation.benchmark import PublishedRow
    from acwm_core.evaluation.results import Counterfactual, Estimate, SetSummary, Summary
    from acwm_severity.curves import SeverityCurve

ROWS = {
    "model": "model",
    "shuffled": "other actions",
    "copy": "first frame",
    "codec": "codec alone",
    "truth": "noise floor",
    "perturbed": "other start",
}
"""Names of the result rows, as the tables show them."""


SHORT = {"In distribution": "InD", "Out of distribution": "OoD"}
"""Short names of splits, for tables whose eight columns must fit a terminal."""


def print_summary(summary: Summary) -> None:
    """Print the scores of every split, the steps curve, and published scores for comparison."""
    from rich.console import Console

    from acwm_report.published import about_published

    console = Console(highlight=False, markup=False)
    for split, result in summary.splits.items():
        console.print(_split_table(summary, split))
        _print_remarks(result.scores)
    click.echo(
        "± is half the 95 % confidence interval over episodes; `other actions`: the model was "
        "given another episode's actions"
    )
    for reason in dict.fromkeys(summary.left_out.values()):
        names = [name for name, why in summary.left_out.items() if why == reason]
        click.echo(f"left out: {', '.join(names)}: {reason}")
    _print_curves(summary)
    if summary.published:
        console.print(_published_table(summary, summary.published.row))
        click.echo(about_published(summary))


def _print_remarks(scores: SetSummary) -> None:
    """Print which predictions failed, and which scores are left out of the means above."""
    for row in scores.failed:
        failures = f"{ROWS.get(row, row)}: {scores.failures(row)}"
        click.echo(f"{failures}: their scores count as infinitely bad")
    undefined = (f"{name} on {count}" for name, count in scores.undefined.items())
    if text := ", ".join(undefined):
        click.echo(
            f"scores not defined and not counted: {text} of {scores.clips} clips of the model"
        )


def print_severity(curve: SeverityCurve) -> None:
    """Print the headline metric: a line per value of the factor, a column per result row."""
    from rich.console import Console

    unit = curve.metrics[curve.headline].unit
    title = f"{curve.headline} {unit}".strip() + f", {curve.episodes} episodes each"
    rows = list(curve.points[0].scores.rows)
    table = plain_table(title, f"{curve.factor} {curve.unit}".strip(), ["severity", *rows])
    for point in curve.points:
        found = [_text(point.scores.rows[row][curve.headline]) for row in rows]
        severity = "train" if point.in_train else f"{point.severity:.2f}"
        table.add_row(str(point.value), severity, *found)
    Console(highlight=False, markup=False).print(table)
    for point in curve.points:
        if phrase := point.scores.failures():
            click.echo(f"{curve.factor} {point.value}: {phrase}")
    if curve.left_out:
        left = " or ".join(f"{value:g}" for value in curve.left_out)
        click.echo(f"{curve.factor} cannot be {left}: left out")


def _text(estimate: Estimate, *, interval: bool = True) -> str:
    """``24.41 ±0.5``: four digits (two if below 0.01), and half the interval if there is one."""
    if estimate.value is None:
        return "–"
    digits = 4 if abs(estimate.value) >= 0.01 else 2  # small values have enough zeros
    text = f"{estimate.value:#.{digits}g}".replace("inf", "∞")
    if interval and estimate.low is not None and estimate.high is not None:
        text += f" ±{(estimate.high - estimate.low) / 2:.1g}"
    return text


def _split_table(summary: Summary, split: str) -> Table:
    scores = summary.splits[split].scores
    clips = f"{scores.clips} clips"
    if scores.episodes != scores.clips:
        clips += f" of {scores.episodes} episodes"
    table = plain_table(f"{split}: {clips}", "", [ROWS.get(row, row) for row in scores.rows])
    for name, metric in summary.metrics.items():
        shown = [
            _text(values[name], interval=row == "model" and name == summary.headline)
            for row, values in scores.rows.items()
        ]
        table.add_row(f"{name} {metric.unit}".strip(), *shown)
    return table


def _print_curves(summary: Summary) -> None:
    """Print the steps curve of every split, and the results that need the simulator."""
    headline = summary.headline
    for split, result in summary.splits.items():
        if result.steps:
            points = [(each.steps, each.scores[headline]) for each in result.steps.points]
            scores = (f"{steps}: {_text(score, interval=False)}" for steps, score in points)
            about = f"{split} {headline} of {result.steps.clips} clips by sampling steps"
            click.echo(f"{about}  {'  '.join(scores)}")
    for split, result in summary.splits.items():
        if result.counterfactual:
            _print_action_response(split, result.counterfactual)
        if result.predictability:
            horizon = result.predictability.horizon
            until = "beyond the last frame" if horizon is None else f"frame {horizon}"
            clips = f"{result.predictability.clips} clips, started a millimetre off"
            click.echo(f"{split}: predictability horizon: {until} ({clips})")


def _print_action_response(split: str, found: Counterfactual) -> None:
    for row, scores in found.rows.items():
        shown = ", ".join(f"{name} {_text(estimate)}" for name, estimate in scores.items())
        gain, residual = found.gain["all"][row], found.residual["all"][row]
        if gain is not None and residual is not None:
            shown += f" (gain {gain:.2f}, residual {residual:.2f})"
        branches = f"{found.branches} other action sequences in {found.clips} clips"
        click.echo(f"{split}: action response of {row}, {branches}: {shown}")


def _published_table(summary: Summary, row: PublishedRow) -> Table:
    from acwm_report import score_grid as made

    quoted = " ".join(["published:", row.row, row.column]).strip()
    models = {summary.run: made.model_scores(summary), quoted: made.published_scores(row)}
    grid = made.ScoreGrid.of(list(models.values()), made.compared_metrics([summary]))
    columns = grid.columns()
    units = {c.title: c.unit for c in columns if c.unit}
    title = "; ".join([*(f"{name} in {unit}" for name, unit in units.items()), made.CAPTION])
    heads = [f"{SHORT.get(c.group, c.group)}\n{c.title}" for c in columns]
    table = plain_table(title, "", heads)
    table.columns[0].no_wrap = False
    for name, scores in models.items():
        table.add_row(name, *(cell.text + "▼" * cell.worse for cell in grid.cells(scores)))
    return table
