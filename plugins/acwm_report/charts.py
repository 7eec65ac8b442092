"""The charts of a report: their curves, titles and labels."""

from __future__ import annotations

import itertools
import math

import numpy as np

from acwm_core.evaluation.metric import MetricInfo
from acwm_core.evaluation.results import Counterfactual, Summary
from acwm_report.figures import Chart, Curve, Numbers
from acwm_report.metrics_file import logged
from acwm_report.run import EvaluatedRun, described
from acwm_report.table import Scale
from acwm_report.titles import ROWS, counted, split_title
from acwm_severity.curves import SeverityCurve, read_severity

SECONDS = "seconds after the first frame"

_COLOURS = {"ind_test": "model", "ood_test": "shuffled"}  # for splits that share a chart


def horizon_charts(run: EvaluatedRun, metric: str) -> list[Chart]:
    """A metric per frame: one chart per split, one curve for each row where it is defined."""
    info, scale = run.summary.metrics[metric], run.scale(metric)
    charts: list[Chart] = []
    for split, result in run.summary.splits.items():
        title, name, curves = split_title(split), f"{run.key}-horizon-{split}", list[Curve]()
        for kind in reversed(ROWS):
            values = result.horizon.get(kind, {}).get(metric, [])[1:]  # frame 0 was given
            if any(value is not None for value in values):
                seconds = [(n + 1) / run.summary.environment["fps"] for n in range(len(values))]
                style = "--" if kind in ("codec", "truth") else "-"
                scaled = _times(values, scale.factor)
                curves.append(Curve(ROWS[kind].title, kind, seconds, scaled, style))
        if metric != run.summary.headline:
            title = f"{info.title}, {title.lower()}"
            name = f"{run.key}-horizon-{metric.replace('_', '-')}-{split}"
        charts.append(Chart(title, name, curves, SECONDS, _axis(info, scale)))
    return charts


def state_horizon_charts(run: EvaluatedRun) -> list[Chart]:
    """State metrics per frame: the first error, and the first score where higher is better."""
    splits, metrics = run.summary.splits.values(), run.summary.metrics
    first: dict[bool, str] = {}
    for name in sorted(run.metrics("states"), key=lambda each: metrics[each].rank):
        curves = [split.horizon.get("model", {}).get(name, ()) for split in splits]
        if name != run.summary.headline and any({*curve} - {None} for curve in curves):
            first.setdefault(metrics[name].higher_is_better, name)
    return [chart for name in first.values() for chart in horizon_charts(run, name)]


def pair_charts(run: EvaluatedRun) -> list[Chart]:
    """Scores with the clip's own actions against another episode's, one chart per split."""
    name = run.summary.headline
    label = _axis(run.headline, Scale(1.0, 0, run.headline.unit))
    charts: list[Chart] = []
    of_both = {s: r for s, r in run.summary.splits.items() if "shuffled" in r.scores.paired}
    for split, result in of_both.items():
        rows = sorted(
            (r for r in run.results if r.split == split), key=lambda r: (r.episode, r.start)
        )
        own, other = ([r.values[name] for r in rows if r.kind == k] for k in ("model", "shuffled"))
        pairs = [pair for pair in zip(other, own, strict=True) if all(map(math.isfinite, pair))]
        values = [value for pair in pairs for value in pair] or [0.0]
        margin = 0.06 * (max(values) - min(values) or 1)
        ends = [min(values) - margin, max(values) + margin]
        pair = result.scores.paired["shuffled"][name]
        title = f"{split_title(split)}: {pair.better} of {pair.clips} better"
        dots = Curve("", "model", [a for a, _ in pairs], [b for _, b in pairs], ".")
        curves = [Curve("", "muted", ends, ends, "raw"), dots]
        axes = f"{label}, another episode’s actions", f"{label}, true actions"
        charts.append(Chart(title, f"{run.key}-pairs-{split}", curves, *axes))
    return charts


def steps_charts(run: EvaluatedRun) -> list[Chart]:
    """The headline metric against sampling steps if they were swept, one curve per split."""
    scale, name = run.headline_scale(), run.summary.headline
    curves: list[Curve] = []
    for split, result in run.summary.splits.items():
        points = result.steps.points if result.steps else []
        steps, colour = [point.steps for point in points], _COLOURS.get(split, "run1")
        scores = _times([point.scores[name].value for point in points], scale.factor)
        curves += [Curve(split_title(split), colour, steps, scores)] * bool(points)
    if not curves:
        return []
    ticks = [(steps, f"{steps:g}") for steps in curves[0].x]
    axes = "sampling steps", _axis(run.headline, scale)
    return [Chart("Sampling steps", f"{run.key}-steps", curves, *axes, True, ticks, log_x=True)]


def response_charts(run: EvaluatedRun) -> list[Chart]:
    """One chart per split and action dimension: true and predicted responses to a shift."""
    charts: list[Chart] = []
    for split, found in counterfactuals(run.summary).items():
        by_size = sorted(found.curves, key=lambda each: abs(each.size))
        for number, curve in enumerate({each.dimension: each for each in by_size}.values()):
            seconds = [n / run.summary.environment["fps"] for n in range(len(curve.truth))]
            curves = [Curve("Simulator", "truth", seconds, _times(curve.truth, 1000), "--")]
            for kind in [each for each in ("codec", "perturbed", "model") if each in curve.rows]:
                values = _times(curve.rows[kind], 1000)
                curves.append(Curve(ROWS[kind].title, kind, seconds, values))
            shift = f"{curve.dimension.replace('_', ' ')} shifted by {curve.shift:.2g} {curve.unit}"
            title, name = f"{split_title(split)}: {shift}", f"{run.key}-response-{split}-{number}"
            charts.append(Chart(title, name, curves, SECONDS, "response (×10⁻³)"))
    return charts


def counterfactuals(summary: Summary) -> dict[str, Counterfactual]:
    """The counterfactual results by split, where there are any."""
    found = {split: result.counterfactual for split, result in summary.splits.items()}
    return {split: each for split, each in found.items() if each and each.rows}


def predictability_charts(run: EvaluatedRun) -> list[Chart]:
    """The effect of a start that is a millimetre off, per frame, if it was simulated."""
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
    label = "error relative to the first frame’s"
    return [Chart(title, f"{run.key}-predictability", curves, SECONDS, label)]


def training_charts(run: EvaluatedRun) -> list[Chart]:
    """The training loss (raw and smoothed) and the validation loss, if there is a log."""
    steps, losses = logged(run.folder, "train/loss")
    curves = [
        Curve("", "model", steps, losses, "raw"),
        Curve("training", "model", steps, smooth(losses)),
        Curve("held-out episodes", "shuffled", *logged(run.folder, "val/loss")),
    ]
    curves = [curve for curve in curves if len(curve.x) > 1]
    if not curves:
        return []
    return [Chart("Loss", f"{run.key}-training", curves, "optimiser steps", "loss", log_y=True)]


def smooth(values: list[float]) -> list[float]:
    """Moving average with a window narrower at the ends; leaves about 40 independent points."""
    place, sums = np.arange(len(values)), np.cumsum([0.0, *values])
    near = np.minimum(len(values) // 80, np.minimum(place, place[::-1]))
    return list((sums[place + near + 1] - sums[place - near]) / (2 * near + 1))


def severity_charts(run: EvaluatedRun) -> list[Chart]:
    """One chart per factor that was swept with the run's weights; the training range is shaded."""
    weights = run.summary.predictor
    return [_severity(curve, run.key) for curve in read_severity(run.folder, weights)]


def outdated_curves(run: EvaluatedRun) -> list[tuple[SeverityCurve, bool]]:
    """Curves of other weights than the evaluated ones, and if they predate the evaluation."""
    facts = run.summary.provenance
    return [
        (curve, curve.provenance["evaluated"] <= facts["evaluated"])
        for curve in read_severity(run.folder)
        if curve.provenance["weights_sha256"] != run.summary.predictor
    ]


def _severity(curve: SeverityCurve, key: str) -> Chart:
    info = described(curve.metrics)[curve.headline]
    kinds = [k for k in ("copy", "codec", "model") if k in curve.points[0].scores.rows]
    scores = {k: [point.scores.rows[k][curve.headline] for point in curve.points] for k in kinds}
    scale = Scale.of((each.value for row in scores.values() for each in row), info)
    places, ticks, shaded = _severity_axis(curve)
    curves: list[Curve] = []
    for kind, row in scores.items():
        ends = [[each.value, each.low, each.high] for each in row]
        values, low, high = (_times(column, scale.factor) for column in zip(*ends, strict=True))
        style = "--" if kind == "codec" else "-"
        curves.append(Curve(ROWS[kind].title, kind, places, values, style, low, high))
    name = curve.factor.replace("_", " ")
    title = f"{name}, {counted(curve.episodes, 'episode')} each"
    file = f"{key}-severity-{curve.factor}"
    axes = f"{name} ({curve.unit})" if curve.unit else name, _axis(info, scale)
    return Chart(title, file, curves, *axes, True, ticks, shaded=shaded)


def _severity_axis(
    curve: SeverityCurve,
) -> tuple[list[float], list[tuple[float, str]], tuple[float, float] | None]:
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


def _axis(info: MetricInfo, scale: Scale) -> str:
    return f"{info.title} ({scale.unit})" if scale.unit else info.title


def _times(values: Numbers, factor: float) -> list[float | None]:
    """Scale the values; None for those that cannot be drawn."""
    return [None if v is None or not math.isfinite(v) else v * factor for v in values]
