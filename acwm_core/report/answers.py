"""How a model answers other actions, and how long the world can be foreseen: charts and a table."""

from __future__ import annotations

from collections.abc import Sequence

from acwm_core.evaluation.results import Counterfactual, ResponseCurve, Summary
from acwm_core.report.charts import Chart, legend_of
from acwm_core.report.figures import Line, line_chart
from acwm_core.report.table import Cell, Column, Row, Table
from acwm_core.report.wording import (
    BESIDE,
    MISSING,
    ROWS,
    Scale,
    branch_title,
    metric_title,
    split_title,
)

_PLAIN = Scale(1.0, 2, "")


def response_tables(summary: Summary) -> list[Table]:
    """One table per split: the answer to every kind of other actions, row beside row."""
    tables: list[Table] = []
    for split, found in _counterfactuals(summary):
        kinds = [kind for kind in BESIDE if kind in found.rows]
        columns = [Column(BESIDE[kind], key=kind) for kind in kinds]
        rows: list[Row] = []
        for metric in found.rows[kinds[0]]:
            scores = {"all": found.rows} | found.kinds
            for branch, by_row in scores.items():
                cells = [
                    Cell.of(by_row[kind][metric], _PLAIN) if kind in by_row else Cell(MISSING)
                    for kind in kinds
                ]
                title = metric_title(metric).title() if branch == "all" else branch_title(branch)
                note = _note(found, branch)
                rows.append(Row(title, note, "", cells, strong=branch == "all"))
        title = f"{split_title(split)} · {found.branches} branches of {found.clips} clips"
        tables.append(Table(title, columns, rows, "Other actions", name=f"response-{split}"))
    return tables


def _note(found: Counterfactual, branch: str) -> str:
    """How much of the true response the model gives, and how much that is none."""
    gain = found.gain.get(branch, {}).get("model")
    stray = found.residual.get(branch, {}).get("model")
    if gain is None or stray is None:
        return ""
    return f"model: gain {_PLAIN.number(gain)}, stray {_PLAIN.number(stray)}"


def response_charts(summary: Summary, key: str) -> list[Chart]:
    """A chart per split and action dimension: the true response to a shift, and the predicted."""
    charts: list[Chart] = []
    for split, found in _counterfactuals(summary):
        dimensions = dict.fromkeys(curve.dimension for curve in found.curves)
        for number, dimension in enumerate(dimensions):
            curves = [curve for curve in found.curves if curve.dimension == dimension]
            largest = max(curves, key=lambda curve: abs(curve.size))
            name = f"{key}-response-{split}-{number}"
            charts.append(_response_chart(summary, split, largest, name))
    return charts


def _response_chart(summary: Summary, split: str, curve: ResponseCurve, name: str) -> Chart:
    seconds = [frame / summary.environment["fps"] for frame in range(len(curve.truth))]
    rows = [kind for kind in ("codec", "perturbed", "model") if kind in curve.rows]
    lines = [Line("Simulator", "truth", seconds, _thousand(curve.truth), dashed=True)]
    lines += [Line(ROWS[kind][0], kind, seconds, _thousand(curve.rows[kind])) for kind in rows]
    drawing = line_chart(lines, "seconds after the first frame", "response (×10⁻³)")
    unit = f" {curve.unit}" if curve.unit else ""
    title = f"{curve.dimension.replace('_', ' ')} shifted by {curve.shift:.2g}{unit}"
    about = f"{title}: how strongly pixels change in truth and prediction."
    return Chart(f"{split_title(split)}: {title}", name, drawing, about, legend_of(lines))


def _thousand(values: Sequence[float | None]) -> list[float | None]:
    return [None if value is None else 1000 * value for value in values]


def predictability_chart(summary: Summary, key: str) -> Chart | None:
    """What a start a millimetre off changes, frame by frame; None if it was not simulated."""
    colours = {"ind_test": "model", "ood_test": "shuffled"}
    lines: list[Line] = []
    horizons: list[str] = []
    fps = summary.environment["fps"]
    for split, result in summary.splits.items():
        found = result.predictability
        if found is None:
            continue
        seconds = [frame / fps for frame in range(len(found.share))]
        title = split_title(split)
        lines.append(Line(title, colours.get(split, "run1"), seconds, found.share))
        if found.horizon is None:
            horizons.append(f"{title}: foreseeable to the end")
        else:
            horizons.append(f"{title}: up to {found.horizon / fps:.1f} s")
    if not lines:
        return None
    drawing = line_chart(lines, "seconds after the first frame", "error, as a share of the copy’s")
    if len({each.partition(": ")[2] for each in horizons}) == 1:
        horizons = [horizons[0].partition(": ")[2].capitalize()]
    title = "; ".join(horizons)
    about = f"Error of a simulation that starts slightly off. {title}."
    return Chart(title, f"{key}-predictability", drawing, about, legend_of(lines))


def _counterfactuals(summary: Summary) -> list[tuple[str, Counterfactual]]:
    return [
        (split, result.counterfactual)
        for split, result in summary.splits.items()
        if result.counterfactual and result.counterfactual.rows
    ]
