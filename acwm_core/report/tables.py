"""The tables of a report, as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from acwm_core.evaluation.results import Estimate, Scores, SplitSummary, Summary
from acwm_core.report.charts import run_colour
from acwm_core.report.wording import (
    MISSING,
    OVER,
    ROWS,
    Scale,
    gain,
    gains,
    headline_scale,
    label_title,
    metric_title,
    split_title,
)


@dataclass(frozen=True)
class Cell:
    """A number and, small below it, its interval."""

    text: str
    interval: str = ""


@dataclass(frozen=True)
class Column:
    """The head of a column: title, unit, and which way is better (``"↑"``, ``"↓"`` or ``""``)."""

    title: str
    unit: str = ""
    better: str = ""


@dataclass(frozen=True)
class Row:
    """A line of a table.

    Attributes:
        title: in the first column.
        note: small below it.
        colour: CSS variable of its swatch, or ``""``.
        cells: one per column.
        strong: set off from the others.
    """

    title: str
    note: str
    colour: str
    cells: list[Cell]
    strong: bool = False


@dataclass(frozen=True)
class Table:
    """A table with its heading."""

    title: str
    columns: list[Column]
    rows: list[Row]


@dataclass(frozen=True)
class Tile:
    """One large number, what it is, and its interval."""

    number: str
    unit: str
    label: str
    note: str


def tiles(summary: Summary, split: str) -> list[Tile]:
    """The four numbers that matter most in a split."""
    name, scale = metric_title(summary.headline), headline_scale(summary)
    scores = summary.splits[split].scores
    score = scores.rows["model"][summary.headline]
    found = [
        Tile(
            scale.number(score.value),
            scale.unit,
            f"{name} with the true actions",
            _ci(scale.interval(score)),
        )
    ]
    for reference, advantage in gains(summary, split).items():
        number = scale.number(advantage.value, signed=True)
        note = _ci(scale.interval(advantage, signed=True))
        found.append(Tile(number, scale.unit, f"over {OVER[reference]}", note))
    pair = scores.paired["shuffled"][summary.headline]
    found.append(
        Tile(f"{pair.better}/{pair.clips}", "", "episodes in which the true actions win", "")
    )
    return found


def split_tables(summary: Summary) -> list[Table]:
    """One table per split: every row in every metric; out of distribution also the change."""
    scales = {
        name: Scale.of(
            (
                row[name].value
                for each in summary.splits.values()
                for row in each.scores.rows.values()
            ),
            info.unit,
        )
        for name, info in summary.metrics.items()
    }
    columns = [
        Column(metric_title(name), scales[name].unit, "↑" if info.higher_is_better else "↓")
        for name, info in summary.metrics.items()
    ]
    tables: list[Table] = []
    for split, result in summary.splits.items():
        rows = [
            _score_row(kind, result.scores.rows[kind], scales)
            for kind in ROWS
            if kind in result.scores.rows
        ]
        if split == "ood_test" and summary.gap:
            cells = [
                _cell(summary.gap["model"][name], scales[name], signed=True) for name in scales
            ]
            rows.append(Row("Change out of distribution", "of the model", "", cells))
        title = f"{split_title(split)} · {result.scores.clips} episodes"
        tables.append(Table(title, columns, rows))
    return tables


def label_table(summary: Summary) -> Table | None:
    """The headline metric by what was shifted; None if nothing was."""
    groups: list[tuple[str, Scores]] = []
    for split, result in summary.splits.items():
        groups.append((split_title(split), result.scores))
        groups += [(f"shifted: {label_title(x)}", scores) for x, scores in result.labels.items()]
    if not any(result.labels for result in summary.splits.values()):
        return None
    name, info = summary.headline, summary.metrics[summary.headline]
    scale = headline_scale(summary)
    columns = [
        Column("Number"),
        Column(metric_title(name), scale.unit),
        Column("over the copy", scale.unit),
        Column("over other actions", scale.unit),
        Column("true actions win"),
        Column("Codec ceiling", scale.unit),
    ]
    whole = {split_title(split) for split in summary.splits}
    rows: list[Row] = []
    for title, scores in groups:
        pair = scores.paired["shuffled"][name]
        advantages = [
            _cell(gain(scores.paired[each][name], info.higher_is_better), scale, signed=True)
            for each in OVER
        ]
        cells = [
            Cell(str(scores.clips)),
            _cell(scores.rows["model"][name], scale),
            *advantages,
            Cell(f"{pair.better}/{pair.clips}"),
            Cell(scale.number(scores.rows["codec"][name].value)),
        ]
        rows.append(Row(title, "", "", cells, strong=title in whole))
    return Table("", columns, rows)


def steps_table(summary: Summary) -> Table | None:
    """The headline metric by the number of sampling steps; None without a sweep."""
    name, scale = summary.headline, headline_scale(summary)
    scale = Scale(scale.factor, scale.decimals + 1, scale.unit)  # steps differ by little
    curves = {s: each.steps for s, each in summary.splits.items() if each.steps}
    if not curves:
        return None
    points = next(iter(curves.values())).points
    columns = [Column(f"{point.steps} step{'s' * (point.steps > 1)}") for point in points]
    rows: list[Row] = []
    for split, curve in curves.items():
        note = f"{metric_title(name)} {scale.unit}, {curve.clips} episodes"
        scores = [_cell(point.scores[name], scale) for point in curve.points]
        rows.append(Row(split_title(split), note, "", scores, strong=True))
        changes = [_cell(point.change[name], scale, signed=True) for point in curve.points]
        rows.append(Row(f"beyond {curve.points[-1].steps} steps", "mean per episode", "", changes))
    return Table("", columns, rows)


def comparison_table(summaries: Sequence[Summary]) -> Table:
    """One row per run: its parts and its headline numbers."""
    first = summaries[0]
    scale = headline_scale(first)
    columns: list[Column] = []
    for split in first.splits:
        short = {"ind_test": "InD", "ood_test": "OoD"}.get(split, split)
        columns += [
            Column(f"{short} {metric_title(first.headline)}", scale.unit),
            Column(f"{short} over copy", scale.unit),
            Column(f"{short} over other actions", scale.unit),
        ]
    rows = [
        Row(
            summary.run,
            _parts(summary),
            run_colour(number),
            _comparison_cells(summary, first.splits, first.headline, scale),
        )
        for number, summary in enumerate(summaries)
    ]
    return Table("", columns, rows)


def _comparison_cells(
    summary: Summary, splits: Iterable[str], name: str, scale: Scale
) -> list[Cell]:
    cells: list[Cell] = []
    for split in splits:
        result: SplitSummary | None = summary.splits.get(split)
        if result is None or name not in summary.metrics:
            cells += [Cell(MISSING)] * 3
            continue
        better = summary.metrics[name].higher_is_better
        cells.append(_cell(result.scores.rows["model"][name], scale))
        for reference in OVER:
            advantage = gain(result.scores.paired[reference][name], better)
            cells.append(_cell(advantage, scale, signed=True))
    return cells


def _score_row(kind: str, row: dict[str, Estimate], scales: dict[str, Scale]) -> Row:
    title, note = ROWS[kind]
    cells = [_cell(row[name], scale) for name, scale in scales.items()]
    return Row(title, note, kind, cells, strong=kind == "model")


def _cell(estimate: Estimate, scale: Scale, *, signed: bool = False) -> Cell:
    text = scale.number(estimate.value, signed=signed)
    return Cell(text, scale.interval(estimate, signed=signed))


def _ci(interval: str) -> str:
    return f"95 %: {interval}" if interval else ""


def _parts(summary: Summary) -> str:
    names = [summary.parts[part] for part in ("env", "model", "conditioner", "codec")]
    return " · ".join([*names, f"{_count(summary.provenance['parameters'])} parameters"])


def _count(number: int) -> str:
    return f"{number / 1e6:.1f} M" if number >= 100_000 else f"{number:,}"
