"""Error against the value of a factor, from the training range outward."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acwm_core.evaluation.results import FOLDER, Summary
from acwm_core.evaluation.severity_results import SEVERITY, SeverityCurve, read_severity
from acwm_core.report.charts import Chart, axis_title, legend_of
from acwm_core.report.figures import Drawing, Line, line_chart
from acwm_core.report.wording import ROWS, Scale, metric_title


@dataclass(frozen=True)
class SeverityCharts:
    """The curves of a run.

    Attributes:
        charts: one per factor that was swept.
        left_out: curves that were made with other weights than the run's evaluation, as a sentence
            and the command that mends it.
    """

    charts: list[Chart] = field(default_factory=list[Chart])
    left_out: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])


def severity_charts(run: Path, key: str) -> SeverityCharts:
    """A chart per factor that was swept; none if none was.

    Args:
        run: the run folder.
        key: of the run on the page.

    Raises:
        DataError: a curve is damaged, or the run was not evaluated.
    """
    if not (run / FOLDER / SEVERITY).is_dir():
        return SeverityCharts()
    facts = Summary.read(run).provenance
    curves = read_severity(run)
    return SeverityCharts(
        [_chart(curve, key) for curve in curves if _same_weights(curve, facts)],
        [_left_out(curve, facts, run) for curve in curves if not _same_weights(curve, facts)],
    )


def _same_weights(curve: SeverityCurve, facts: Mapping[str, Any]) -> bool:
    return curve.provenance["weights_sha256"] == facts["weights_sha256"]


def _left_out(curve: SeverityCurve, facts: Mapping[str, Any], run: Path) -> tuple[str, str]:
    """Whichever of the two was made first is to be made anew."""
    older = curve.provenance["evaluated"] <= facts["evaluated"]
    sweep = f" --sweep {shlex.quote(curve.text)}" if older else ""
    return (
        f"The curve of {curve.factor.replace('_', ' ')} is left out, because it is of "
        f"{'earlier' if older else 'later'} weights of this run than the rest of this page: make "
        f"{'the curve' if older else 'the rest'} anew with",
        f"acwm evaluate {run}{sweep}",
    )


def _chart(curve: SeverityCurve, key: str) -> Chart:
    info = curve.metrics[curve.headline]
    kinds = [k for k in ("copy", "codec", "model") if k in curve.points[0].scores.rows]
    scores = {
        kind: [point.scores.rows[kind][curve.headline] for point in curve.points] for kind in kinds
    }
    scale = Scale.of((each.value for row in scores.values() for each in row), info.unit)
    numbers, ticks = _abscissae(curve)
    lines = [
        Line(
            ROWS[kind][0],
            kind,
            numbers,
            _scaled([each.value for each in scores[kind]], scale),
            dashed=kind == "codec",
            low=_scaled([each.low for each in scores[kind]], scale),
            high=_scaled([each.high for each in scores[kind]], scale),
        )
        for kind in kinds
    ]
    name = curve.factor.replace("_", " ")
    x_label = f"{name} ({curve.unit})" if curve.unit else name
    drawing: Drawing = line_chart(
        lines,
        x_label,
        axis_title(curve.headline, scale.unit),
        points=True,
        labels=ticks,
        shaded=_training(curve),
    )
    title = f"{name}, {curve.episodes} episodes each"
    about = f"{metric_title(curve.headline)} against {name}; the band is the training range."
    return Chart(title, f"{key}-severity-{curve.factor}", drawing, about, legend_of(lines))


def _abscissae(curve: SeverityCurve) -> tuple[list[float], list[tuple[float, str]]]:
    """Where the points stand, and how the axis is labelled; words stand one after the other."""
    values = [point.value for point in curve.points]
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        numbers = [float(value) for value in values]
        discrete = curve.kind == "discrete"
        return numbers, [(n, f"{n:g}") for n in numbers] if discrete else []
    return [float(i) for i in range(len(values))], [(i, str(v)) for i, v in enumerate(values)]


def _training(curve: SeverityCurve) -> tuple[float, float] | None:
    """The part of the axis that training covers."""
    numbers, _ = _abscissae(curve)
    inside = [x for x, point in zip(numbers, curve.points, strict=True) if point.in_train]
    if curve.kind == "continuous":
        low, high = float(curve.train[0]), float(curve.train[1])
        return max(low, min(numbers)), min(high, max(numbers))
    margin = 0.3 * min((abs(b - a) for a, b in itertools.pairwise(numbers)), default=1)
    return (min(inside) - margin, max(inside) + margin) if inside else None


def _scaled(values: Sequence[float | None], scale: Scale) -> list[float | None]:
    return [None if value is None else value * scale.factor for value in values]
