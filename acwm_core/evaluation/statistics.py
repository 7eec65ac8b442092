"""From scores of clips to a summary: means, paired differences, bootstrap intervals, curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.evaluation.results import (
    ClipResult,
    Estimate,
    Paired,
    Scores,
    SplitSummary,
    StepsCurve,
    StepsPoint,
    finite,
)
from acwm_core.metric import Metric

RESAMPLES = 1000
"""Bootstrap resamples behind every interval."""

INTERVAL = (0.025, 0.975)

REFERENCES = ("copy", "shuffled")
"""Rows that the model is compared with, clip by clip."""

Metrics = Mapping[str, Metric]


@dataclass(frozen=True)
class Column:
    """The scores of one row in one metric, clip by clip, and how much each clip counts."""

    values: NDArray[np.float64]
    weights: NDArray[np.float64]

    def summary(self, metric: Metric, chosen: NDArray[np.int64] | slice = slice(None)) -> float:
        """The metric's own summary of the chosen clips."""
        return metric.summarise(self.values[chosen].tolist(), self.weights[chosen].tolist())

    def spread(self, metric: Metric, draws: NDArray[np.int64]) -> NDArray[np.float64]:
        """The summaries of bootstrap samples."""
        return np.array([self.summary(metric, draw) for draw in draws])


Table = Mapping[str, Mapping[str, Column]]
"""Columns by row and metric, clips in the same order."""


def summarise_split(
    results: Sequence[ClipResult],
    metrics: Metrics,
    seed: int,
    sweep: Mapping[int, Sequence[ClipResult]] | None = None,
) -> SplitSummary:
    """Everything about one split.

    Args:
        results: of all rows of its clips.
        metrics: by the name under which `results` hold their scores.
        seed: of the bootstrap.
        sweep: the model's row alone, by the number of sampling steps, each of the same clips.
    """
    labels = sorted({r.ood_label for r in results if r.ood_label is not None})
    by_label = {label: [r for r in results if r.ood_label == label] for label in labels}
    return SplitSummary(
        scores=summarise(results, metrics, seed),
        labels={label: summarise(group, metrics, seed) for label, group in by_label.items()},
        horizon=horizon(results, metrics),
        steps=steps_curve(sweep, metrics, seed) if sweep else None,
    )


def summarise(results: Sequence[ClipResult], metrics: Metrics, seed: int) -> Scores:
    """Scores of a set of clips with their intervals."""
    table = tabulate(results, metrics)
    clips = sum(r.kind == "model" for r in results)
    draws = resamples(clips, seed)
    rows = {kind: _estimates(row, metrics, draws) for kind, row in table.items()}
    paired = {
        reference: {
            name: compare(column.values, table[reference][name].values, metrics[name], draws)
            for name, column in table["model"].items()
        }
        for reference in REFERENCES
    }
    return Scores(clips, rows, paired)


def steps_curve(
    sweep: Mapping[int, Sequence[ClipResult]], metrics: Metrics, seed: int
) -> StepsCurve:
    """The scores of the model's row against the number of sampling steps."""
    rows = {steps: tabulate(sweep[steps], metrics)["model"] for steps in sorted(sweep)}
    clips = len(sweep[max(sweep)])
    draws = resamples(clips, seed)
    points = [
        StepsPoint(
            steps,
            _estimates(row, metrics, draws),
            {
                name: compare(
                    column.values, rows[max(rows)][name].values, metrics[name], draws
                ).difference
                for name, column in row.items()
            },
        )
        for steps, row in rows.items()
    ]
    return StepsCurve(clips, points)


def gap(
    inside: Sequence[ClipResult], outside: Sequence[ClipResult], metrics: Metrics, seed: int
) -> dict[str, dict[str, Estimate]]:
    """Scores out of distribution minus those in distribution, by row and metric.

    The two splits hold different episodes and are resampled independently.
    """
    near, far = tabulate(inside, metrics), tabulate(outside, metrics)
    return {
        kind: {
            name: _difference(near[kind][name], far[kind][name], metric, seed)
            for name, metric in metrics.items()
        }
        for kind in near
    }


def horizon(
    results: Sequence[ClipResult], metrics: Metrics
) -> dict[str, dict[str, list[float | None]]]:
    """The score of each frame summed up over clips, by row and metric; None where undefined."""
    frames = max(r.frames for r in results)
    found: dict[str, dict[str, list[float | None]]] = {}
    for kind in dict.fromkeys(r.kind for r in results):
        row = [r for r in results if r.kind == kind]
        found[kind] = {
            name: [_at_frame(row, name, frame, metric) for frame in range(frames)]
            for name, metric in metrics.items()
        }
    return found


def tabulate(results: Sequence[ClipResult], metrics: Metrics) -> Table:
    """Scores as arrays, clips in order of their episode."""
    ordered = sorted(results, key=lambda r: r.episode)
    table: dict[str, dict[str, Column]] = {}
    for kind in dict.fromkeys(r.kind for r in results):
        row = [r for r in ordered if r.kind == kind]
        table[kind] = {
            name: Column(
                np.array([r.values[name] for r in row]), np.array([r.weights[name] for r in row])
            )
            for name in metrics
        }
    return table


def resamples(count: int, seed: int) -> NDArray[np.int64]:
    """Indices of bootstrap samples, `[RESAMPLES, count]`."""
    return np.random.default_rng(seed).integers(count, size=(RESAMPLES, count))


def compare(
    model: NDArray[np.float64],
    reference: NDArray[np.float64],
    metric: Metric,
    draws: NDArray[np.int64],
) -> Paired:
    """The mean difference of pairs, with its interval, and how often the model is better."""
    equal = model == reference  # two perfect predictions differ by nothing, not by inf − inf
    with np.errstate(invalid="ignore"):
        difference = np.where(equal, 0.0, model - reference)
        spread = difference[draws].mean(1)
        mean = float(difference.mean())
    better = difference > 0 if metric.higher_is_better else difference < 0
    return Paired(_with_interval(mean, spread), int(better.sum()), len(difference))


def _estimates(
    row: Mapping[str, Column], metrics: Metrics, draws: NDArray[np.int64]
) -> dict[str, Estimate]:
    """The summary of one row in each metric, with its interval."""
    return {
        name: _with_interval(column.summary(metrics[name]), column.spread(metrics[name], draws))
        for name, column in row.items()
    }


def _difference(near: Column, far: Column, metric: Metric, seed: int) -> Estimate:
    inside = near.spread(metric, resamples(len(near.values), seed))
    outside = far.spread(metric, resamples(len(far.values), seed + 1))
    with np.errstate(invalid="ignore"):
        return _with_interval(far.summary(metric) - near.summary(metric), outside - inside)


def _with_interval(value: float, spread: NDArray[np.float64]) -> Estimate:
    if not np.all(np.isfinite(spread)):
        return Estimate(finite(value))
    low, high = np.quantile(spread, INTERVAL)
    return Estimate(finite(value), finite(low), finite(high))


def _at_frame(row: Sequence[ClipResult], name: str, frame: int, metric: Metric) -> float | None:
    scores = [
        (r.curves[name][frame], r.weights[name])
        for r in row
        if frame < r.frames and not np.isnan(r.curves[name][frame])
    ]
    if not scores:
        return None
    values, weights = zip(*scores, strict=True)
    return finite(metric.summarise(values, weights))
