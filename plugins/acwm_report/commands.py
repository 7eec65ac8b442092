"""`acwm report`, `compare` and `leaderboard`: show evaluated runs and compare them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.arguments import FOLDER, OUT_FILE, OUT_FOLDER, RUN

if TYPE_CHECKING:
    from rich.console import Console

    from acwm_report.comparison import Comparison, Difference


@click.command()
@click.argument("runs", type=FOLDER, nargs=-1, required=True, metavar="RUN...")
@click.option("--out", type=OUT_FILE, help="Output .html; report.html in the first RUN by default.")
@click.option(
    "--export", type=OUT_FOLDER, metavar="DIR", help="Also write tables and figures to this folder."
)
@click.option("--video-mb", default=16.0, help="Megabytes of video to embed.")
def report(runs: tuple[Path, ...], out: Path | None, export: Path | None, video_mb: float) -> None:
    """Write the report of evaluated runs.

    One self-contained HTML file with tables, curves and videos. Several runs are compared. An
    experiment's folder stands for its evaluated runs. --export writes the tables as CSV, Markdown
    and LaTeX, and the figures as PNG and PDF.
    """
    from acwm_experiment.table import Experiment, is_experiment
    from acwm_report.run import evaluated_runs

    found: list[Path] = []
    for run in runs:
        found += evaluated_runs(run) if is_experiment(run) else [RUN.convert(run, None, None)]
    experiment = Experiment.read(runs[0]) if len(runs) == 1 and is_experiment(runs[0]) else None

    from acwm_report.page import export_report, write_report

    home = runs[0] if is_experiment(runs[0]) else found[0]
    page = write_report(
        found, out or home / "report.html", megabytes=video_mb, experiment=experiment
    )
    click.echo(page)
    click.echo(f"{page.stat().st_size / 1e6:.1f} MB", err=True)
    if export:
        click.echo(f"{len(export_report(found, export, experiment))} files in {export}")


@click.command()
@click.argument("runs", type=RUN, nargs=-1, required=True, metavar="RUN RUN...")
@click.option("--metric", "metrics", multiple=True, help="Compare this metric; all by default.")
@click.option("--split", "splits", multiple=True, help="Compare on this split; all by default.")
@click.option("--out", type=OUT_FILE, help="Also write the result to this .json.")
def compare(
    runs: tuple[Path, ...], metrics: tuple[str, ...], splits: tuple[str, ...], out: Path | None
) -> None:
    """Test which runs differ significantly.

    Compares every pair of runs on common clips with a paired bootstrap over episodes. p-values are
    corrected for the number of comparisons (Holm).
    """
    from rich.console import Console

    from acwm_report.comparison import compare_runs

    comparison = compare_runs(runs, metrics=metrics, splits=splits)
    # A, B … Z, then A1, B1 …, because run names are too long for a table in a terminal
    letters = {run: f"{chr(65 + n % 26)}{n // 26 or ''}" for n, run in enumerate(comparison.runs)}
    for label, letter in letters.items():
        click.echo(f"{letter}: {label}")
    print_tables(Console(highlight=False, markup=False), comparison, letters)
    click.echo(
        "difference: second − first, mean per episode, with its 95 % interval; wins: episodes in "
        "which the second is better; p is corrected for "
        f"{comparison.tests} comparisons (Holm); better: significantly, p < 0.05"
    )
    print_uses(Console(highlight=False, markup=False), comparison, letters)
    for warning in comparison.warnings:
        click.echo(f"warning: {warning}", err=True)
    if out:
        comparison.write(out)
        click.echo(out)


@click.command()
@click.argument("folder", type=FOLDER, metavar="DIR")
@click.option("--out", type=OUT_FILE, help="Output .html; leaderboard.html in DIR by default.")
def leaderboard(folder: Path, out: Path | None) -> None:
    """Collect the results of many runs in one page.

    Finds result files (summary.json) at any depth below DIR and makes one table per environment,
    test data and protocol. Names files that cannot be read.
    """
    from acwm_report.leaderboard import write_leaderboard

    page, found = write_leaderboard(folder, out)
    for name, why in found.broken.items():
        click.echo(f"left out {name}: {why}", err=True)
    click.echo(page)


def print_tables(console: Console, comparison: Comparison, letters: Mapping[str, str]) -> None:
    """Print a table per split; on a narrow terminal, long names and intervals wrap."""
    from rich.table import Table

    if not console.is_terminal:  # a file or a pipe has no width: a line per comparison
        console.width = 10_000
    for split in dict.fromkeys(each.split for each in comparison.differences):
        table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, title=split)
        table.title_justify, table.title_style = "left", "bold"
        table.add_column("metric", overflow="fold")
        table.add_column("runs", no_wrap=True)
        table.add_column("difference", justify="right", no_wrap=True)
        table.add_column("95 %", justify="right", overflow="fold")
        for name in ("wins", "p"):
            table.add_column(name, justify="right", no_wrap=True)
        table.add_column("better", no_wrap=True)
        for each in comparison.differences:
            if each.split == split:
                table.add_row(*_line(each, comparison.units[each.metric], letters))
        console.print(table)


def print_uses(console: Console, comparison: Comparison, letters: Mapping[str, str]) -> None:
    """Print rankings and plans, if there are any: a row per task and measure, a column per run."""
    from rich.table import Table

    from acwm_report.uses import use_table

    found = use_table(comparison.uses, [*comparison.runs])
    if found is None:
        return
    if not console.is_terminal:
        console.width = 10_000
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, title=found.title)
    table.title_justify, table.title_style = "left", "bold"
    table.add_column("", overflow="fold")
    for row in found.rows:
        table.add_column(letters[row.title], justify="right", overflow="fold")
    for place, column in enumerate(found.columns):
        title = f"{column.group}, {column.title.lower()} {column.better} {column.unit}"
        cells = (row.cells[place] for row in found.rows)
        values = (f"{c.text} ({c.interval})" if c.interval else c.text for c in cells)
        table.add_row(" ".join(title.split()), *values)
    console.print(table)


def _line(each: Difference, unit: str, letters: Mapping[str, str]) -> tuple[str, ...]:
    pair = f"{letters[each.first]} → {letters[each.second]}"
    change = f"{each.difference:+.3g} {unit}".strip().replace("inf", "∞").replace("+nan", "–")
    known = each.low is not None and each.high is not None
    interval = f"{each.low:+.3g} to {each.high:+.3g}" if known else "–"
    wins = f"{each.second_better}/{each.episodes}"
    p = "–" if each.p_corrected is None else f"{each.p_corrected:.2g}"
    none = "too few" if each.p is None and math.isfinite(each.difference) else "neither"
    better = letters[each.winner] if each.winner else none
    return each.metric, pair, change, interval, wins, p, better
