"""The table of a report that says which differences between its runs are larger than chance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from acwm_core.errors import DataError
from acwm_core.evaluation.results import Estimate, Summary
from acwm_core.report.comparison import Comparison, compare_runs
from acwm_core.report.table import Cell, Column, Row, Table
from acwm_core.report.wording import MISSING, Scale, metric_title, split_title


def significance_table(folders: Sequence[Path]) -> Table | str:
    """All pairs of runs in their headline metric, or why they cannot be compared.

    Args:
        folders: of the runs.
    """
    try:
        headline = Summary.read(folders[0]).headline
        return comparison_rows(compare_runs(folders, metrics=[headline]))
    except DataError as refused:
        return str(refused)


def comparison_rows(comparison: Comparison) -> Table:
    """A line per pair of runs, split and metric."""
    columns = [
        Column("Split", key="split"),
        Column("Difference", "second − first", key="difference"),
        Column("Second better", key="second_better"),
        Column("p", "Holm", key="p_corrected"),
        Column("Larger than chance?", key="winner"),
    ]
    rows: list[Row] = []
    for each in comparison.differences:
        scale = Scale.of([each.first_mean, each.second_mean], comparison.units[each.metric])
        p = MISSING if each.p_corrected is None else f"{each.p_corrected:.2g}"
        verdict = f"{each.winner} is better" if each.winner else "no"
        cells = [
            Cell(split_title(each.split)),
            Cell.of(Estimate(each.difference, each.low, each.high), scale, signed=True),
            Cell(f"{each.second_better}/{each.episodes}"),
            Cell(p, value=each.p_corrected),
            Cell(verdict if each.p is not None else f"{each.episodes} episodes are too few"),
        ]
        note = f"{metric_title(each.metric)} {scale.unit}".strip()
        rows.append(Row(f"{each.first} → {each.second}", note, "", cells, bool(each.winner)))
    warnings = " ".join(f"{each[:1].upper()}{each[1:]}." for each in comparison.warnings)
    caption = (
        "Mean difference per episode on the clips that both predicted, with its 95 % interval. "
        f"Paired bootstrap over episodes; p-values corrected for {comparison.tests} comparisons "
        "(Holm), so that a table without any real difference holds a false alarm in one of twenty "
        f"cases. {warnings}"
    )
    return Table("", columns, rows, "Runs", caption.strip(), name="comparison")
