"""From the scores of clips to the summary of a split."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from acwm_core.evaluation.metric import Metric, SetMetric
from acwm_core.evaluation.results import Score, SetSummary, SplitSummary, StepsCurve, StepsPoint
from acwm_core.evaluation.statistics import (
    ClipScores,
    Estimate,
    Paired,
    Summarise,
    compare,
    finite,
    gap_between,
)

Metrics = Mapping[str, Metric]


def summarise_split(
    results: Sequence[Score],
    metrics: Metrics,
    seed: int,
    sweep: Mapping[int, Sequence[Score]] | None = None,
) -> SplitSummary:
    """Summarise one split from the `results` of all rows and, by sampling steps, of the model."""
    labels = sorted({r.ood_label for r in results if r.ood_label is not None})
    return SplitSummary(
        scores=summarise(results, metrics, seed),
        labels={
            label: summarise([r for r in results if r.ood_label == label], metrics, seed)
            for label in labels
        },
        horizon=horizon(results, metrics),
        steps=steps_curve(sweep, metrics, seed) if sweep else None,
    )


def summarise(results: Sequence[Score], metrics: Metrics, seed: int) -> SetSummary:
    """The summary of a set of clips, with confidence intervals."""
    table = tabulate(results, metrics)
    model = [r for r in results if r.kind == "model"]
    paired = {
        reference: _compared(table["model"], table[reference], metrics, seed)
        for reference in ("copy", "shuffled")
        if reference in table
    }
    rows = {
        kind: {name: scores.estimate(seed) for name, scores in row.items()}
        for kind, row in table.items()
    }
    failed = Counter(r.kind for r in results if r.failed)
    undefined = {
        name: sum(math.isnan(r.values[name]) for r in model)
        for name, metric in metrics.items()
        if not isinstance(metric, SetMetric)
    }
    left_out = {name: count for name, count in undefined.items() if count}
    return SetSummary(
        clips=len(model),
        rows=rows,
        paired=paired,
        episodes=len({r.episode for r in model}),
        failed=dict(failed),
        undefined=left_out,
        shares={kind: shares([r for r in results if r.kind == kind]) for kind in table},
    )


def shares(row: Sequence[Score]) -> dict[str, float]:
    """The mean share that is scored of the clips of a row, by metric; see `Metric.coverage`."""
    by_metric: dict[str, list[float]] = {}
    for score in row:
        for name, share in score.shares.items():
            by_metric.setdefault(name, []).append(share)
    known = {name: [x for x in values if not math.isnan(x)] for name, values in by_metric.items()}
    return {name: float(np.mean(values)) for name, values in known.items() if values}


def steps_curve(sweep: Mapping[int, Sequence[Score]], metrics: Metrics, seed: int) -> StepsCurve:
    """The model's scores against the number of sampling steps, in the metrics measured there."""
    measured = sweep[max(sweep)][0].values
    metrics = {name: metric for name, metric in metrics.items() if name in measured}
    rows = {steps: tabulate(sweep[steps], metrics)["model"] for steps in sorted(sweep)}
    points: list[StepsPoint] = []
    for steps, row in rows.items():
        beyond = _compared(row, rows[max(rows)], metrics, seed)
        change = {name: paired.difference for name, paired in beyond.items()}
        points.append(StepsPoint(steps, {n: s.estimate(seed) for n, s in row.items()}, change))
    return StepsCurve(len(sweep[max(sweep)]), points)


def _compared(
    row: Mapping[str, ClipScores], other: Mapping[str, ClipScores], metrics: Metrics, seed: int
) -> dict[str, Paired]:
    return {
        name: compare(s, other[name], higher_is_better=metrics[name].higher_is_better, seed=seed)
        for name, s in row.items()
    }


def gap(
    inside: Sequence[Score], outside: Sequence[Score], metrics: Metrics, seed: int
) -> dict[str, dict[str, Estimate]]:
    """The scores out of distribution minus those in distribution, by row and metric."""
    near, far = tabulate(inside, metrics), tabulate(outside, metrics)
    return {
        kind: {name: gap_between(near[kind][name], far[kind][name], seed) for name in metrics}
        for kind in near
    }


def horizon(results: Sequence[Score], metrics: Metrics) -> dict[str, dict[str, list[float | None]]]:
    """The score of each frame summarised over clips, by row and metric; None where undefined."""
    frames = max(r.frames for r in results)
    kinds = dict.fromkeys(r.kind for r in results)
    rows = {kind: [r for r in results if r.kind == kind] for kind in kinds}
    return {
        kind: {name: _curve(row, name, metric, frames) for name, metric in metrics.items()}
        for kind, row in rows.items()
    }


def tabulate(results: Sequence[Score], metrics: Metrics) -> dict[str, dict[str, ClipScores]]:
    """Scores as arrays by row and metric, with clips sorted by episode and start."""
    ordered = sorted(results, key=lambda r: (r.episode, r.start))
    return {
        kind: {
            name: scores_of([r for r in ordered if r.kind == kind], name, metric)
            for name, metric in metrics.items()
        }
        for kind in dict.fromkeys(r.kind for r in results)
    }


def scores_of(row: Sequence[Score], name: str, metric: Metric) -> ClipScores:
    """The scores of one row in one metric, summarised in the metric's own way."""
    whole = None
    if isinstance(metric, SetMetric):
        features = [r.features[name] for r in row if name in r.features]
        whole = metric.distance_of(features) if features else float("nan")
        whole = metric.worst if any(r.failed for r in row) else whole
    return ClipScores(
        np.array([r.values[name] for r in row], np.float64),
        np.array([r.weights[name] for r in row], np.float64),
        np.array([(r.episode, r.start) for r in row], np.int64),
        summary_of(metric),
        whole,
        metric.bounds,
    )


def summary_of(metric: Metric) -> Summarise | None:
    """The function that summarises its scores; None stands for the weighted mean (faster)."""
    return None if type(metric).summarise is Metric.summarise else metric.summed_up


def _curve(row: Sequence[Score], name: str, metric: Metric, frames: int) -> list[float | None]:
    scores = np.full((len(row), frames), np.nan)
    for line, result in zip(scores, row, strict=True):
        line[: result.frames] = result.curves[name]
    weights = np.array([r.weights[name] for r in row], np.float64)
    defined = ~np.isnan(scores) & (weights > 0)[:, None]
    return [
        finite(metric.summed_up(scores[held, frame], weights[held])) if held.any() else None
        for frame, held in enumerate(defined.T)
    ]
