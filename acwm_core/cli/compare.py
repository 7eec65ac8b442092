"""`acwm compare` and `acwm leaderboard`: runs beside one another."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from acwm_core.cli.folders import FOLDER, OUT_FILE, RUN

if TYPE_CHECKING:
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
    Console(highlight=False).print(_table(comparison, letters))
    click.echo(
        "difference: second − first, mean per episode, with its 95 % interval; wins: episodes in "
        "which the second is better; p is corrected for "
        f"{comparison.tests} comparisons (Holm); beyond chance: p < 0.05"
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


def _table(comparison: Comparison, letters: Mapping[str, str]) -> Table:
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0))
    for name in ("split", "metric", "runs"):
        table.add_column(name, no_wrap=True)
    for name in ("difference", "95 %", "wins", "p"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("beyond chance?", no_wrap=True)
    for each in comparison.differences:
        pair = f"{letters[each.first]} → {letters[each.second]}"
        wins = f"{each.second_better}/{each.episodes}"
        change = f"{each.difference:+.3g} {comparison.units[each.metric]}".strip()
        p = "–" if each.p_corrected is None else f"{each.p_corrected:.2g}"
        words = (each.split, each.metric, pair, change, _interval(each), wins, p)
        table.add_row(*words, _verdict(each, letters))
    return table


def _interval(each: Difference) -> str:
    if each.low is None or each.high is None:
        return "–"
    return f"{each.low:+.3g} to {each.high:+.3g}"


def _verdict(each: Difference, letters: Mapping[str, str]) -> str:
    if each.p is None:
        return "too few clips"
    return f"{letters[each.winner]} is better" if each.winner else "no"
