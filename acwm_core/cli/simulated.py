"""What only the simulator can tell, on the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from acwm_core.cli.numbers import estimate_text

if TYPE_CHECKING:
    from acwm_core.evaluation.results import Counterfactual, Summary
    from acwm_core.evaluation.severity_results import SeverityCurve


def print_simulated(summary: Summary) -> None:
    """Print, per split, the responses to other actions and the predictability horizon."""
    for split, result in summary.splits.items():
        if result.counterfactual:
            _print_responses(split, result.counterfactual)
        if result.predictability:
            horizon = result.predictability.horizon
            until = "beyond the last frame" if horizon is None else f"frame {horizon}"
            clips = f"{result.predictability.clips} clips, started a millimetre off"
            click.echo(f"{split}: predictability horizon: {until} ({clips})")


def print_severity(curve: SeverityCurve) -> None:
    """Print a line per value of the factor; a column per row of the headline metric."""
    from rich.console import Console
    from rich.table import Table

    unit = curve.metrics[curve.headline].unit
    title = f"{curve.headline} {unit}".strip() + f", {curve.episodes} episodes each"
    table = Table(box=None, title=title, title_justify="left")
    table.add_column(f"{curve.factor} {curve.unit}".strip(), justify="right")
    table.add_column("severity", justify="right")
    rows = list(curve.points[0].scores.rows)
    for row in rows:
        table.add_column(row, justify="right")
    for point in curve.points:
        found = [estimate_text(point.scores.rows[row][curve.headline]) for row in rows]
        severity = "train" if point.in_train else f"{point.severity:.2f}"
        table.add_row(str(point.value), severity, *found)
    Console(highlight=False).print(table)
    if curve.left_out:
        left = " or ".join(f"{value:g}" for value in curve.left_out)
        click.echo(f"{curve.factor} cannot be {left}: left out")


def _print_responses(split: str, found: Counterfactual) -> None:
    for row, scores in found.rows.items():
        shown = ", ".join(f"{name} {estimate_text(estimate)}" for name, estimate in scores.items())
        gain, residual = found.gain["all"][row], found.residual["all"][row]
        if gain is not None and residual is not None:
            shown += f" (gain {gain:.2f}, residual {residual:.2f})"
        branches = f"{found.branches} other action sequences in {found.clips} clips"
        click.echo(f"{split}: action response of {row}, {branches}: {shown}")
