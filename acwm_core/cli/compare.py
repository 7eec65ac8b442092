"""`acwm compare` and `acwm leaderboard`: runs beside one another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.folders import FOLDER, OUT_FILE, RUN

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from acwm_core.report.comparison import Comparison, Difference


@click.command()
@click.argument("runs", type=RUN, nargs=-1, required=True, metavar="RUN RUN...")
@click.option("--metric", "metrics", multiple=True, help="Compare this metric; all by default.")
@click.option("--split", "splits", multiple=True, help="Compare on this split; all by default.")
@click.option("--out", type=OUT_FILE, help="A .json to write as well.")
def compare(
    runs: tuple[Path, ...], metrics: tuple[str, ...], splits: tuple[str, ...], out: Path | None
) -> None:
    """Say which differences between evaluated runs are larger than chance.

    Every pair of runs is compared on the clips that both predicted, by a paired bootstrap over
    episodes; the p-values are corrected for the number of comparisons (Holm).
    """
    from rich.console import Console

    from acwm_core.report.comparison import compare_runs

    comparison = compare_runs(runs, metrics=metrics, splits=splits)
    letters = {label: _letter(number) for number, label in enumerate(comparison.runs)}
    for label, letter in letters.items():
        click.echo(f"{letter}: {label}")
    print_tables(Console(highlight=False), comparison, letters)
    click.echo(
        "difference: second − first, mean per episode, with its 95 % interval; wins: episodes in "
        "which the second is better; p is corrected for "
        f"{comparison.tests} comparisons (Holm); better: which one is by more than chance, p < 0.05"
    )
    for warning in comparison.warnings:
        click.echo(f"warning: {warning}", err=True)
    if out:
        comparison.write(out)
        click.echo(out)


@click.command()
@click.argument("folder", type=FOLDER, metavar="DIR")
@click.option(
    "--out", type=OUT_FILE, help="The .html to write; leaderboard.html in DIR by default."
)
def leaderboard(folder: Path, out: Path | None) -> None:
    """Collect the results of all runs below DIR into one page.

    One table per environment, test data and protocol. Result files (summary.json) may lie at any
    depth, with or without the rest of their run; those that cannot be read are named.
    """
    from acwm_core.report.leaderboard import write_leaderboard

    page, found = write_leaderboard(folder, out)
    for name, why in found.broken.items():
        click.echo(f"left out {name}: {why}", err=True)
    click.echo(page)


def _letter(number: int) -> str:
    """A, B … Z, then A1, B1 …: names of runs are too long for a terminal's table."""
    return chr(ord("A") + number % 26) + (str(number // 26) if number >= 26 else "")


def print_tables(console: Console, comparison: Comparison, letters: Mapping[str, str]) -> None:
    """Print a table per split; on a narrow terminal long names and intervals take several lines."""
    for split in dict.fromkeys(each.split for each in comparison.differences):
        table = _table(comparison, letters, split)
        if not console.is_terminal:  # a file or a pipe has no width: a line per comparison
            console.width = max(console.width, _full_width(console, table))
        console.print(table)


def _full_width(console: Console, table: Table) -> int:
    from rich.measure import Measurement

    return Measurement.get(console, console.options.update(max_width=10_000), table).maximum


def _table(comparison: Comparison, letters: Mapping[str, str], split: str) -> Table:
    from rich.table import Table

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
            table.add_row(*_words(each, comparison.units[each.metric], letters))
    return table


def _words(each: Difference, unit: str, letters: Mapping[str, str]) -> tuple[str, ...]:
    """A line of the table."""
    pair = f"{letters[each.first]} → {letters[each.second]}"
    change = f"{each.difference:+.3g} {unit}".strip()
    wins = f"{each.second_better}/{each.episodes}"
    p = "–" if each.p_corrected is None else f"{each.p_corrected:.2g}"
    return each.metric, pair, change, _interval(each), wins, p, _verdict(each, letters)


def _interval(each: Difference) -> str:
    if each.low is None or each.high is None:
        return "–"
    return f"{each.low:+.3g} to {each.high:+.3g}"


def _verdict(each: Difference, letters: Mapping[str, str]) -> str:
    if each.p is None:
        return "too few"
    return letters[each.winner] if each.winner else "neither"
