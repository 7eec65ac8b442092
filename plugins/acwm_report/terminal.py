"""What the commands print: scores, curves, comparisons."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import click

from acwm_core.cli.tables import print_table
from acwm_report.draws import draws_phrase
from acwm_report.titles import counted, short_title

if TYPE_CHECKING:
    from rich.console import Console

    from acwm_core.evaluation.protocol import PublishedRow
    from acwm_core.evaluation.results import (
        Counterfactual,
        Ensemble,
        Estimate,
        SetSummary,
        Summary,
    )
    from acwm_planning.policies.ranking import Ranking
    from acwm_report.comparison import Comparison, Difference
    from acwm_report.table import Table as PageTable
    from acwm_severity.curves import SeverityCurve

SHORT = {"In distribution": "InD", "Out of distribution": "OoD"}
"""Short names of splits, for tables whose eight columns must fit a terminal."""


MUCH = 1 / 3
"""Share of the squared error from which on a better codec is worth a word."""


def print_summary(summary: Summary) -> None:
    """Print the scores of every split, the steps curve, and published scores for comparison."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    for split, result in summary.splits.items():
        print_table(console, *_split_table(summary, split))
        _print_remarks(result.scores, summary.handed_in)
        if phrase := draws_phrase(summary, split):
            click.echo(f"{split}: {phrase}")
    click.echo(_about_intervals(summary))
    if any("shuffled" in result.scores.rows for result in summary.splits.values()):
        click.echo("`other actions`: the model with another episode's actions")
    if any(r.scores.shares.get("model") for r in summary.splits.values()):
        click.echo("scored: share of bodies and frames in which the object was detected")
    for reason in dict.fromkeys(summary.left_out.values()):
        names = [name for name, why in summary.left_out.items() if why == reason]
        click.echo(f"left out: {', '.join(names)}: {reason}")
    _print_curves(summary)
    if summary.published:
        print_table(console, *_published_table(summary, summary.published.row))
        click.echo(about_published(summary))


def _about_intervals(summary: Summary) -> str:
    """What ± means, and why splits have none."""
    from acwm_report.run import too_few

    few = too_few(summary)
    return f"± is half the 95 % confidence interval over episodes{f', {few}' if few else ''}"


def _print_remarks(scores: SetSummary, handed_in: bool) -> None:
    """Print where the error comes from, which predictions failed, and which scores are left out."""
    better = "submit PNG or NPZ" if handed_in else "see `acwm train-codec`"
    from acwm_core.evaluation.shares import error_shares

    if found := error_shares(scores):
        click.echo(f"{found}{f' ({better})' if found.codec > MUCH else ''}")
    for row in scores.failed:
        failures = f"{short_title(row)}: {scores.failures(row)}"
        click.echo(f"{failures}: their scores are infinitely bad")
    undefined = (f"{name} on {count}" for name, count in scores.undefined.items())
    if text := ", ".join(undefined):
        click.echo(f"undefined scores, not counted: {text} of {counted(scores.clips, 'clip')}")


def print_severity(curve: SeverityCurve) -> None:
    """Print the headline metric: a line per value of the factor, a column per result row."""
    from rich.console import Console

    unit = curve.metrics[curve.headline].unit
    about = f"by {curve.factor} {curve.unit}".strip()
    episodes = counted(curve.episodes, "episode")
    title = f"{curve.headline} {unit}".strip() + f", {episodes} each, {about}"
    rows = list(curve.points[0].scores.rows)
    lines: list[tuple[str, list[str]]] = []
    for point in curve.points:
        found = [_text(point.scores.rows[row][curve.headline]) for row in rows]
        severity = "train" if point.in_train else f"{point.severity:.2f}"
        lines.append((str(point.value), [severity, *found]))
    console = Console(highlight=False, markup=False)
    print_table(console, title, ["severity", *rows], lines)
    for point in curve.points:
        if phrase := point.scores.failures():
            click.echo(f"{curve.factor} {point.value}: {phrase}")
    if curve.left_out:
        left = " or ".join(f"{value:g}" for value in curve.left_out)
        click.echo(f"{curve.factor} cannot be {left}: left out")


def _text(estimate: Estimate, *, interval: bool = True) -> str:
    """``24.41 ±0.5``: four digits (two if below 0.01), and half the interval, ``±–`` if none."""
    if estimate.value is None:
        return "–"
    digits = 4 if abs(estimate.value) >= 0.01 else 2  # small values have enough zeros
    text = f"{estimate.value:#.{digits}g}".replace("inf", "∞")
    if interval and estimate.low is not None and estimate.high is not None:
        text += f" ±{(estimate.high - estimate.low) / 2:.1g}"
    elif interval and math.isfinite(estimate.value):
        text += " ±–"
    return text


def _split_table(
    summary: Summary, split: str
) -> tuple[str, list[str], list[tuple[str, list[str]]]]:
    """Title, headings and rows of the scores of a split."""
    scores = summary.splits[split].scores
    clips = counted(scores.clips, "clip")
    if scores.episodes != scores.clips:
        clips += f" of {counted(scores.episodes, 'episode')}"
    heads = [short_title(row) for row in scores.rows]
    shares = scores.shares.get("model", {})
    place = list(scores.rows).index("model") + 1
    if shares:
        heads.insert(place, "scored")
    rows: list[tuple[str, list[str]]] = []
    for name, metric in summary.metrics.items():
        shown = [
            _text(values[name], interval=row == "model" and name == summary.headline)
            for row, values in scores.rows.items()
        ]
        if shares:
            shown.insert(place, f"{100 * shares[name]:.0f} %" if name in shares else "")
        rows.append((f"{name} {metric.unit}".strip(), shown))
    title = ", ".join(filter(None, (f"{split}: {clips}", summary.unfinished)))
    return title, heads, rows


def _print_curves(summary: Summary) -> None:
    """Print the steps curve of every split, and the results that need the simulator."""
    headline = summary.headline
    for split, result in summary.splits.items():
        if result.steps:
            points = [(each.steps, each.scores[headline]) for each in result.steps.points]
            scores = (f"{steps}: {_text(score, interval=False)}" for steps, score in points)
            about = f"{split} {headline} of {counted(result.steps.clips, 'clip')} by sampling steps"
            click.echo(f"{about}  {'  '.join(scores)}")
    for split, result in summary.splits.items():
        if result.counterfactual:
            _print_action_response(split, result.counterfactual)
        if result.predictability:
            horizon = result.predictability.horizon
            until = "beyond the last frame" if horizon is None else f"frame {horizon}"
            clips = f"{counted(result.predictability.clips, 'clip')}, started a millimetre off"
            click.echo(f"{split}: predictability horizon: {until} ({clips})")
    for split, found in summary.ensembles.items():
        _print_ensemble(split, found)


def _print_ensemble(split: str, found: Ensemble) -> None:
    named = {row: short_title(row) for row in found.distance}
    named["simulator"] = "simulator, half against half"
    away, apart = (
        ", ".join(f"{named[row]} {_text(each, interval=False)}" for row, each in of.items())
        for of in (found.distance, found.spread)
    )
    drawn = f"{found.draws} draws" if found.draws > 1 else "one prediction"
    click.echo(
        f"{split}: energy distance to the simulator's futures from {found.starts} starts, "
        f"{1000 * found.moved:.2g} mm off, of {counted(found.clips, 'clip')} ({drawn}): {away}"
    )
    apart = apart.replace(", half against half", "")
    click.echo(f"{split}: mean distance between two futures: {apart}")


def _print_action_response(split: str, found: Counterfactual) -> None:
    for row, scores in found.rows.items():
        shown = ", ".join(f"{name} {_text(estimate)}" for name, estimate in scores.items())
        gain, residual = found.gain["all"][row], found.residual["all"][row]
        if gain is not None and residual is not None:
            shown += f" (gain {gain:.2f}, residual {residual:.2f})"
        branches = counted(found.branches, "other action sequence")
        branches += f" in {counted(found.clips, 'clip')}"
        click.echo(f"{split}: action response of {row}, {branches}: {shown}")


def _published_table(
    summary: Summary, row: PublishedRow
) -> tuple[str, list[str], list[tuple[str, list[str]]]]:
    """Title, headings and rows of the scores beside published ones."""
    from acwm_report import scores as made

    quoted = " ".join(["published:", row.row, row.column]).strip()
    models = {summary.run: made.model_scores(summary), quoted: made.published_scores(row)}
    grid = made.ScoreGrid.of(list(models.values()), made.compared_metrics([summary]))
    columns = grid.columns()
    units = {c.title: c.unit for c in columns if c.unit}
    title = "; ".join([*(f"{name} in {unit}" for name, unit in units.items()), made.CAPTION])
    heads = [f"{SHORT.get(c.group, c.group)}\n{c.title}" for c in columns]
    rows = [
        (name, [cell.text + "▼" * cell.worse for cell in grid.cells(scores)])
        for name, scores in models.items()
    ]
    return title, heads, rows


def about_published(summary: Summary) -> str:
    """Where the published figures of a run come from and how far they are comparable, as text."""
    from acwm_core.evaluation.protocol import published_tables

    if not summary.published:
        return ""
    row, same = summary.published.row, summary.published.same_parts
    setting = ", ".join(str(row.setting[name]) for name in ("model", "codec", "conditioner"))
    facts = [f"published: {row.citation}, {row.label} ({setting})"]
    if not (same or summary.handed_in):  # what made predictions handed in is not known
        facts.append("this run has other components")
    table = published_tables().get(row.table)  # none where its plugin is not installed
    if table and summary.protocol != table.protocol:
        to_compare = f"--protocol {table.protocol}"
        if summary.handed_in:
            to_compare = f"`acwm benchmark export evaluation.protocol={table.protocol}`"
        facts.append(f"measured on other clips: compare with {to_compare}")
    return "; ".join(facts) + (f". {row.note}" if row.note else "")


def print_comparison(comparison: Comparison) -> None:
    """Print which runs differ: a table per split, their usefulness, and warnings."""
    # A, B … Z, then A1, B1 …, because run names are too long for a table in a terminal
    letters = {run: f"{chr(65 + n % 26)}{n // 26 or ''}" for n, run in enumerate(comparison.runs)}
    for label, letter in letters.items():
        click.echo(f"{letter}: {label}")
    console = _console()
    print_tables(console, comparison, letters)
    corrected = f"corrected for {counted(comparison.tests, 'comparison')} (Holm)"
    if not comparison.tests:
        corrected = "none, because there are too few episodes"
    click.echo(
        "difference: second − first, mean per episode, with its 95 % interval; wins: episodes in "
        f"which the second is better; p: {corrected}; better: significantly, p < 0.05"
    )
    _print_uses(console, comparison, letters)
    for warning in comparison.warnings:
        click.echo(f"warning: {warning}", err=True)


def print_tables(console: Console, comparison: Comparison, letters: Mapping[str, str]) -> None:
    """Print a table per split; on a narrow terminal, columns that do not fit follow below."""
    heads = ["difference", "95\N{NO-BREAK SPACE}%", "wins", "p", "better"]
    for split in dict.fromkeys(each.split for each in comparison.differences):
        rows = [
            _line(each, comparison.units[each.metric], letters)
            for each in comparison.differences
            if each.split == split
        ]
        print_table(console, split, heads, rows, first="metric", close=True)


def _print_uses(console: Console, comparison: Comparison, letters: Mapping[str, str]) -> None:
    """Print rankings and plans, if there are any: a row per task and measure, a column per run."""
    from acwm_report.uses import use_table

    found = use_table(comparison.uses, [*comparison.runs])
    if found is None:
        return
    rows: list[tuple[str, list[str]]] = []
    for place, column in enumerate(found.columns):
        title = f"{column.group}, {column.title.lower()} {column.better} {column.unit}"
        cells = (row.cells[place] for row in found.rows)
        values = [f"{c.text} ({c.interval})" if c.interval else c.text for c in cells]
        rows.append((" ".join(title.split()), values))
    print_table(console, found.title, [letters[row.title] for row in found.rows], rows, close=True)


def print_page_table(table: PageTable) -> None:
    """Print a table of a page: below each number is its 95 % interval, as there."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    heads = [" ".join(f"{c.title} {c.unit} {c.better}".split()) for c in table.columns]
    rows = [
        (row.title, [f"{cell.text}\n{cell.interval}".rstrip() for cell in row.cells])
        for row in table.rows
    ]
    print_table(console, table.title, heads, rows, first=table.corner, close=True)
    console.print(table.caption)


def print_ranking(ranking: Ranking) -> None:
    """Print the policies, best true score first, and how well the judges agree with the truth."""
    from acwm_report.rankings import ranking_table

    console = _console()
    rows: list[tuple[str, list[str]]] = []
    for policy in ranking.policies:
        success = [f"{100 * policy.success[judge]:.0f} %" for judge in ("truth", "model")]
        returns = [f"{policy.returns[judge]:.3g}" for judge in ("truth", "model")]
        rows.append((policy.policy, [policy.loop, *success, *returns]))
    heads = ["loop", "success (true)", "success (model)", "return (true)", "return (model)"]
    print_table(console, None, heads, rows, first="policy", close=True)
    for policy in ranking.policies:
        for judge, count in policy.unread.items():
            console.print(
                f"{policy.policy}: in {count} of {ranking.episodes} episodes the estimator could "
                f"not read the distance in the {'true' if judge == 'estimator' else 'predicted'} "
                "frames; the start distance is used instead"
            )
    print_page_table(ranking_table(ranking))
    click.echo("MMRV: mean maximum rank violation; optimism: judge minus truth")


def _console() -> Console:
    """Where tables go; a file or a pipe has no width, so a row is one line there."""
    from rich.console import Console

    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = 10_000
    return console


def _line(each: Difference, unit: str, letters: Mapping[str, str]) -> tuple[str, tuple[str, ...]]:
    """Which metric and runs, and the cells of a difference."""
    pair = f"{letters[each.first]} → {letters[each.second]}"
    change = f"{each.difference:+.3g} {unit}".strip().replace("inf", "∞").replace("+nan", "–")
    known = each.low is not None and each.high is not None
    interval = f"{each.low:+.3g} to {each.high:+.3g}" if known else "–"
    wins = f"{each.second_better}/{each.episodes}"
    p = "–" if each.p_corrected is None else f"{each.p_corrected:.2g}"
    none = "too few" if each.p is None and math.isfinite(each.difference) else "neither"
    better = letters[each.winner] if each.winner else none
    return f"{each.metric} {pair}", (change, interval, wins, p, better)
