"""The tables of a report, as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from acwm_core.evaluation.results import Estimate, Scores, SplitSummary, Summary
from acwm_core.report.charts import run_colour
from acwm_core.report.table import Cell, Column, Row, Table
from acwm_core.report.wording import (
    BESIDE,
    MISSING,
    OVER,
    PIXELS,
    ROWS,
    Scale,
    gain,
    gains,
    headline_scale,
    label_title,
    metric_scale,
    metric_title,
    split_title,
)


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
    """One table per split: every row in the pixel metrics; out of distribution also the change."""
    names = [name for name in summary.metrics if name in PIXELS] or list(summary.metrics)
    scales = {name: metric_scale(summary, name) for name in names}
    columns = [_metric_column(summary, name, scales[name]) for name in names]
    tables: list[Table] = []
    for split, result in summary.splits.items():
        found = result.scores.rows
        rows = [
            _score_row(kind, found[kind], scales)
            for kind in ROWS
            if kind in found and any(found[kind][name].value is not None for name in names)
        ]
        if split == "ood_test" and summary.gap:
            gaps = summary.gap["model"]
            cells = [Cell.of(gaps[name], scales[name], signed=True) for name in names]
            rows.append(Row("Change out of distribution", "of the model", "", cells))
        title = f"{split_title(split)} · {clips_title(result.scores)}"
        tables.append(Table(title, columns, rows, "Prediction", name=f"scores-{split}"))
    return tables


def measure_tables(summary: Summary) -> list[Table]:
    """One table per split with a line per metric that is not of pixels, and floors beside scores.

    The columns are the rows of the evaluation. A metric that is defined nowhere is left out, and
    so is a row in which none is.
    """
    names = [name for name in summary.metrics if name not in PIXELS]
    if len(names) == len(summary.metrics):
        return []
    tables: list[Table] = []
    for split, result in summary.splits.items():
        found = result.scores.rows
        kinds = [
            kind
            for kind in BESIDE
            if kind in found and any(found[kind][name].value is not None for name in names)
        ]
        rows: list[Row] = []
        for name in names:
            scale = metric_scale(summary, name)
            cells = [Cell.of(found[kind][name], scale) for kind in kinds]
            if any(cell.value is not None for cell in cells):
                way = "higher is better" if summary.metrics[name].higher_is_better else ""
                note = ", ".join(filter(None, (scale.unit, way or "lower is better")))
                rows.append(Row(metric_title(name), note, "", cells))
        if rows:
            columns = [Column(BESIDE[kind], key=kind) for kind in kinds]
            title = f"{split_title(split)} · {clips_title(result.scores)}"
            tables.append(Table(title, columns, rows, "Metric", name=f"measures-{split}"))
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
            Cell.of(gain(scores.paired[each][name], info.higher_is_better), scale, signed=True)
            for each in OVER
        ]
        cells = [
            Cell(str(scores.clips)),
            Cell.of(scores.rows["model"][name], scale),
            *advantages,
            Cell(f"{pair.better}/{pair.clips}"),
            Cell(scale.number(scores.rows["codec"][name].value)),
        ]
        rows.append(Row(title, "", "", cells, strong=title in whole))
    return Table("", columns, rows, "Episodes", name="shifts")


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
        scores = [Cell.of(point.scores[name], scale) for point in curve.points]
        rows.append(Row(split_title(split), note, "", scores, strong=True))
        changes = [Cell.of(point.change[name], scale, signed=True) for point in curve.points]
        rows.append(Row(f"beyond {curve.points[-1].steps} steps", "mean per episode", "", changes))
    return Table("", columns, rows, "Split", name="steps")


def comparison_table(summaries: Sequence[Summary], names: Sequence[str]) -> Table:
    """One row per run: its parts and its headline numbers.

    Args:
        summaries: of the runs.
        names: of the runs.
    """
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
            names[number],
            _parts(summary),
            run_colour(number),
            _comparison_cells(summary, first.splits, first.headline, scale),
        )
        for number, summary in enumerate(summaries)
    ]
    return Table("", columns, rows, "Run", name="runs")


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
        cells.append(Cell.of(result.scores.rows["model"][name], scale))
        for reference in OVER:
            advantage = gain(result.scores.paired[reference][name], better)
            cells.append(Cell.of(advantage, scale, signed=True))
    return cells


def clips_title(scores: Scores) -> str:
    """``12 episodes``, or ``120 clips of 12 episodes``."""
    if scores.episodes in (0, scores.clips):
        return f"{scores.clips} episodes"
    return f"{scores.clips} clips of {scores.episodes} episodes"


def _metric_column(summary: Summary, name: str, scale: Scale) -> Column:
    better = "↑" if summary.metrics[name].higher_is_better else "↓"
    return Column(metric_title(name), scale.unit, better, key=name)


def _score_row(kind: str, row: dict[str, Estimate], scales: dict[str, Scale]) -> Row:
    title, note = ROWS[kind]
    cells = [
        Cell.of(row[name], scale) if name in row else Cell(MISSING)
        for name, scale in scales.items()
    ]
    return Row(title, note, kind, cells, strong=kind == "model")


def _ci(interval: str) -> str:
    return f"95 %: {interval}" if interval else ""


def _parts(summary: Summary) -> str:
    names = [summary.parts[part] for part in ("env", "model", "conditioner", "codec")]
    return " · ".join([*names, f"{_count(summary.provenance['parameters'])} parameters"])


def _count(number: int) -> str:
    return f"{number / 1e6:.1f} M" if number >= 100_000 else f"{number:,}"
