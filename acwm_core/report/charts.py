"""The charts of a report: which curves, with which words around them."""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from acwm_core.evaluation.results import Counterfactual, ResponseCurve, Summary
from acwm_core.evaluation.severity_results import SeverityCurve, read_severity
from acwm_core.report.figures import Chart, Curve, Numbers
from acwm_core.report.run import ROWS, EvaluatedRun, described, in_split, split_title
from acwm_core.report.table import Scale

RUN_COLOURS = 8
"""Number of colours that the page has for runs, ``--run1`` and so on."""

SMOOTHED_POINTS = 40
"""About how many independent points a smoothed curve shows."""

SECONDS = "seconds after the first frame"

_COLOURS = {"ind_test": "model", "ood_test": "shuffled"}  # of splits that share a chart


def horizon_charts(run: EvaluatedRun, metric: str) -> list[Chart]:
    """A metric of each frame, one chart per split, a curve for every row where it is defined."""
    charts: list[Chart] = []
    for split, result in run.summary.splits.items():
        rows = {kind: row.get(metric, ()) for kind, row in result.horizon.items()}
        kinds = [kind for kind in reversed(ROWS) if {*rows.get(kind, ())} - {None}]
        curves = [_horizon(run, split, metric, kind, run.scale(metric)) for kind in kinds]
        chart = _horizon_chart(run, split, metric, curves, f"{run.key}-horizon-{split}")
        if metric != run.summary.headline:
            title = f"{run.summary.metrics[metric].title}, {chart.title.lower()}"
            name = f"{run.key}-horizon-{metric.replace('_', '-')}-{split}"
            chart = replace(chart, title=title, name=name)
        charts.append(chart)
    return charts


def state_horizon_charts(run: EvaluatedRun) -> list[Chart]:
    """What is read of each frame: the first error, and the first score that is better higher."""
    splits, metrics = run.summary.splits.values(), run.summary.metrics
    first: dict[bool, str] = {}
    for name in sorted(run.metrics("states"), key=lambda each: metrics[each].rank):
        curves = [split.horizon.get("model", {}).get(name, ()) for split in splits]
        if name != run.summary.headline and any({*curve} - {None} for curve in curves):
            first.setdefault(metrics[name].higher_is_better, name)
    return [chart for name in first.values() for chart in horizon_charts(run, name)]


def horizon_comparison(runs: Sequence[EvaluatedRun], names: Sequence[str]) -> list[Chart]:
    """The model's curve of every run over the copied first frame, one chart per split.

    Args:
        runs: on one environment.
        names: of the runs.
    """
    first, metric = runs[0], runs[0].summary.headline
    scale = first.scale(metric)
    charts: list[Chart] = []
    for split in first.summary.splits:
        curves = [replace(_horizon(first, split, metric, "copy", scale), style="--")]
        for number, run in enumerate(runs):
            if split in run.summary.splits and metric in run.summary.metrics:
                curve = _horizon(run, split, metric, "model", scale)
                curves.append(replace(curve, title=names[number], colour=run_colour(number)))
        charts.append(_horizon_chart(first, split, metric, curves, f"compared-horizon-{split}"))
    return charts


def _horizon(run: EvaluatedRun, split: str, metric: str, kind: str, scale: Scale) -> Curve:
    """A row from frame 1 on, as frame 0 was given."""
    values = run.summary.splits[split].horizon[kind][metric][1:]
    seconds = [(index + 1) / run.summary.environment["fps"] for index in range(len(values))]
    style = "--" if kind in ("codec", "truth") else "-"
    return Curve(ROWS[kind][0], kind, seconds, _times(values, scale.factor), style)


def _horizon_chart(
    run: EvaluatedRun, split: str, metric: str, curves: Sequence[Curve], name: str
) -> Chart:
    measure, scale = run.summary.metrics[metric].title, run.scale(metric)
    ends = ", ".join(
        f"{curve.title} {scale.number(last / scale.factor)}"
        for curve in curves
        if (last := curve.y[-1]) is not None
    )
    title = split_title(split)
    about = f"{measure} of each frame, {title.lower()}; in the last frame {ends}."
    return Chart(title, name, about, curves, SECONDS, axis_title(measure, scale.unit))


def pair_charts(run: EvaluatedRun) -> list[Chart]:
    """Each clip with its own and with another episode's actions, one chart per split."""
    name = run.summary.headline
    label = axis_title(run.headline.title, run.headline.unit)
    charts: list[Chart] = []
    for split, result in run.summary.splits.items():
        rows = sorted(in_split(run.results, split), key=lambda r: (r.episode, r.start))
        own, other = ([r.values[name] for r in rows if r.kind == k] for k in ("model", "shuffled"))
        pairs = [pair for pair in zip(other, own, strict=True) if all(map(math.isfinite, pair))]
        values = [value for pair in pairs for value in pair] or [0.0]
        margin = 0.06 * (max(values) - min(values) or 1)
        ends = [min(values) - margin, max(values) + margin]
        pair = result.scores.paired["shuffled"][name]
        title = f"{split_title(split)}: {pair.better} of {pair.clips} better"
        about = f"{title} with the true actions than with other actions."
        dots = Curve("", "model", [a for a, _ in pairs], [b for _, b in pairs], ".")
        curves = [Curve("", "muted", ends, ends, "raw"), dots]
        axes = f"{label}, another episode’s actions", f"{label}, true actions"
        charts.append(Chart(title, f"{run.key}-pairs-{split}", about, curves, *axes))
    return charts


def steps_charts(run: EvaluatedRun) -> list[Chart]:
    """The headline metric against sampling steps, a curve per split, if they were swept."""
    scale, name = run.headline_scale(), run.summary.headline
    sweeps = {s: each.steps.points for s, each in run.summary.splits.items() if each.steps}
    curves: list[Curve] = []
    for split, points in sweeps.items():
        steps, colour = [point.steps for point in points], _COLOURS.get(split, "run1")
        scores = _times([point.scores[name].value for point in points], scale.factor)
        curves.append(Curve(split_title(split), colour, steps, scores))
    if not curves:
        return []
    ticks = [(steps, f"{steps:g}") for steps in curves[0].x]
    about = f"{run.headline.title} against the number of sampling steps."
    axes = "sampling steps", axis_title(run.headline.title, scale.unit)
    name = f"{run.key}-steps"
    return [Chart("Sampling steps", name, about, curves, *axes, True, ticks, log_x=True)]


def response_charts(run: EvaluatedRun) -> list[Chart]:
    """A chart per split and action dimension: the true response to a shift, and the predicted."""
    charts: list[Chart] = []
    for split, found in counterfactuals(run.summary).items():
        dimensions = dict.fromkeys(curve.dimension for curve in found.curves)
        for number, dimension in enumerate(dimensions):
            curves = [curve for curve in found.curves if curve.dimension == dimension]
            largest = max(curves, key=lambda curve: abs(curve.size))
            charts.append(_response(run, split, largest, f"{run.key}-response-{split}-{number}"))
    return charts


def _response(run: EvaluatedRun, split: str, curve: ResponseCurve, name: str) -> Chart:
    seconds = [frame / run.summary.environment["fps"] for frame in range(len(curve.truth))]
    rows = [kind for kind in ("codec", "perturbed", "model") if kind in curve.rows]
    curves = [Curve("Simulator", "truth", seconds, _times(curve.truth, 1000), "--")]
    curves += [Curve(ROWS[k][0], k, seconds, _times(curve.rows[k], 1000)) for k in rows]
    shift = f"{curve.dimension.replace('_', ' ')} shifted by {curve.shift:.2g} {curve.unit}".strip()
    about = f"{shift}: how strongly pixels change in truth and prediction."
    title = f"{split_title(split)}: {shift}"
    return Chart(title, name, about, curves, SECONDS, "response (×10⁻³)")


def counterfactuals(summary: Summary) -> dict[str, Counterfactual]:
    """What was measured under other actions, by split."""
    found = {split: result.counterfactual for split, result in summary.splits.items()}
    return {split: each for split, each in found.items() if each and each.rows}


def predictability_charts(run: EvaluatedRun) -> list[Chart]:
    """What a start a millimetre off changes, frame by frame, if it was simulated."""
    fps = run.summary.environment["fps"]
    curves: list[Curve] = []
    horizons: list[str] = []
    for split, result in run.summary.splits.items():
        if found := result.predictability:
            seconds = [frame / fps for frame in range(len(found.share))]
            colour = _COLOURS.get(split, "run1")
            curves.append(Curve(split_title(split), colour, seconds, found.share))
            until = "the whole clip" if found.horizon is None else f"{found.horizon / fps:.1f} s"
            horizons.append(f"{until} {split_title(split).lower()}")
    if not curves:
        return []
    title = "Predictability horizon: " + "; ".join(horizons)
    about = f"Error of a simulation that starts slightly off. {title}."
    label = "error, as a share of the copy’s"
    return [Chart(title, f"{run.key}-predictability", about, curves, SECONDS, label)]


def training_charts(run: EvaluatedRun) -> list[Chart]:
    """The training loss, raw and smoothed, and the validation loss, if there is a log."""
    steps, losses = _logged(run.folder, "train/loss")
    curves = [
        Curve("", "model", steps, losses, "raw"),
        Curve("training", "model", steps, smooth(losses)),
        Curve("held-out episodes", "shuffled", *_logged(run.folder, "val/loss")),
    ]
    curves = [curve for curve in curves if len(curve.x) > 1]
    if not curves:
        return []
    ends = ", ".join(f"{curve.title} {curve.y[-1]:.3g}" for curve in curves if curve.title)
    about = f"Loss over the steps; at the end: {ends}."
    name = f"{run.key}-training"
    return [Chart("Loss", name, about, curves, "optimiser steps", "loss", log_y=True)]


def _logged(run: Path, column: str) -> tuple[list[float], list[float]]:
    """Steps and values of a column of ``metrics.csv``, where it has a value."""
    file = run / "metrics.csv"
    if not file.exists():
        return [], []
    with file.open(newline="", encoding="utf-8") as opened:
        rows = [row for row in csv.DictReader(opened) if row.get(column)]
    return [float(row["step"]) for row in rows], [float(row[column]) for row in rows]


def smooth(values: list[float]) -> list[float]:
    """Mean over a window around each value, narrower at the ends."""
    reach = len(values) // (2 * SMOOTHED_POINTS)
    smoothed: list[float] = []
    for index in range(len(values)):
        near = min(reach, index, len(values) - 1 - index)
        window = values[index - near : index + near + 1]
        smoothed.append(sum(window) / len(window))
    return smoothed


def severity_charts(run: EvaluatedRun) -> tuple[list[Chart], list[tuple[SeverityCurve, bool]]]:
    """A chart per factor that was swept, from the training range outward.

    Returns:
        The charts, and the curves that are left out because they are of other weights than the
        run's evaluation, with whether they are older than it.

    Raises:
        DataError: a curve is damaged.
    """
    facts, shown, others = run.summary.provenance, list[Chart](), list[tuple[SeverityCurve, bool]]()
    for curve in read_severity(run.folder):
        if curve.provenance["weights_sha256"] == facts["weights_sha256"]:
            shown.append(_severity(curve, run.key))
        else:
            others.append((curve, curve.provenance["evaluated"] <= facts["evaluated"]))
    return shown, others


def _severity(curve: SeverityCurve, key: str) -> Chart:
    info = described(curve.metrics)[curve.headline]
    kinds = [k for k in ("copy", "codec", "model") if k in curve.points[0].scores.rows]
    scores = {k: [point.scores.rows[k][curve.headline] for point in curve.points] for k in kinds}
    values = (each.value for row in scores.values() for each in row)
    scale = Scale.of(values, info.unit, info.factor)
    places, ticks, shaded = _severity_axis(curve)
    curves: list[Curve] = []
    for kind, row in scores.items():
        values, low, high = (
            _times([getattr(each, end) for each in row], scale.factor)
            for end in ("value", "low", "high")
        )
        style = "--" if kind == "codec" else "-"
        curves.append(Curve(ROWS[kind][0], kind, places, values, style, low, high))
    name = curve.factor.replace("_", " ")
    return Chart(
        f"{name}, {curve.episodes} episodes each",
        f"{key}-severity-{curve.factor}",
        f"{info.title} against {name}; the band is the training range.",
        curves,
        axis_title(name, curve.unit),
        axis_title(info.title, scale.unit),
        points=True,
        ticks=ticks,
        shaded=shaded,
    )


def _severity_axis(
    curve: SeverityCurve,
) -> tuple[list[float], list[tuple[float, str]], tuple[float, float] | None]:
    """Where the points stand, how the axis is marked, and the part of it that training covers."""
    values = [point.value for point in curve.points]
    if curve.kind == "continuous":
        places = [float(value) for value in values]
        low, high = float(curve.train[0]), float(curve.train[1])
        return places, [], (max(low, min(places)), min(high, max(places)))
    words = any(isinstance(value, str | bool) for value in values)
    places = [float(n if words else value) for n, value in enumerate(values)]
    ticks = [(x, f"{v}" if words else f"{x:g}") for x, v in zip(places, values, strict=True)]
    inside = [x for x, point in zip(places, curve.points, strict=True) if point.in_train]
    margin = 0.3 * min((abs(b - a) for a, b in itertools.pairwise(places)), default=1)
    return places, ticks, (min(inside) - margin, max(inside) + margin) if inside else None


def run_colour(number: int) -> str:
    """The colour of the run of that number, from 0; they repeat when there are many."""
    return f"run{number % RUN_COLOURS + 1}"


def axis_title(what: str, unit: str) -> str:
    """What stands along an axis: ``PSNR (dB)``."""
    return f"{what} ({unit})" if unit else what


def _times(values: Numbers, factor: float) -> list[float | None]:
    return [None if value is None else value * factor for value in values]
