"""From scores of clips to a summary: means, paired differences, bootstrap intervals, curves."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.evaluation.clip_results import ClipResult
from acwm_core.evaluation.results import (
    Estimate,
    Paired,
    Scores,
    SplitSummary,
    StepsCurve,
    StepsPoint,
    finite,
)
from acwm_core.metric import Metric, SetMetric

RESAMPLES = 1000
"""Bootstrap resamples behind every interval."""

INTERVAL = (0.025, 0.975)

REFERENCES = ("copy", "shuffled")
"""Rows that the model is compared with, clip by clip."""

Metrics = Mapping[str, Metric]


@dataclass(frozen=True)
class Column:
    """The scores of one row in one metric, clip by clip.

    Attributes:
        values: `[N]`, NaN where a clip has no score.
        weights: how much each clip counts, `[N]`.
        clips: episode and start of each, `[N, 2]`, in order.
        features: `[N, 2, D]` if the metric compares sets.
    """

    values: NDArray[np.float64]
    weights: NDArray[np.float64]
    clips: NDArray[np.int64]
    features: NDArray[np.float32] | None = None

    def defined(self) -> Column:
        """The clips that have a score and count."""
        return self.only(~np.isnan(self.values) & (self.weights > 0))

    def only(self, kept: NDArray[np.bool_]) -> Column:
        """Some of the clips."""
        return Column(self.values[kept], self.weights[kept], self.clips[kept])

    def estimate(self, metric: Metric, seed: int) -> Estimate:
        """The metric's summary of the clips, with its interval."""
        if isinstance(metric, SetMetric):
            return Estimate(finite(self.summary(metric)))
        held = self.defined()
        return _with_interval(held.summary(metric), held.spread(metric, seed))

    def summary(self, metric: Metric) -> float:
        """The metric's own summary of clips, all of which have a score."""
        if isinstance(metric, SetMetric):
            return float("nan") if self.features is None else metric.distance(self.features)
        return metric.summarise(self.values, self.weights) if len(self.values) else float("nan")

    def spread(self, metric: Metric, seed: int) -> NDArray[np.float64]:
        """The summaries of bootstrap samples of clips, all of which have a score."""
        if not len(self.values):
            return np.full(RESAMPLES, np.nan)
        counts = episode_resamples(tuple(self.clips[:, 0].tolist()), seed)
        if type(metric).summarise is Metric.summarise:  # the same, some hundred times as fast
            return means(self.values, counts * self.weights)
        drawn = (counts * self.weights).astype(np.float64)
        return np.array([metric.summarise(self.values, weights) for weights in drawn])


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
    model = [r for r in results if r.kind == "model"]
    rows = {
        kind: {name: column.estimate(metrics[name], seed) for name, column in row.items()}
        for kind, row in table.items()
    }
    paired = {
        reference: {
            name: compare(column, table[reference][name], metrics[name], seed)
            for name, column in table["model"].items()
        }
        for reference in REFERENCES
        if reference in table
    }
    return Scores(len(model), rows, paired, episodes=len({r.episode for r in model}))


def steps_curve(
    sweep: Mapping[int, Sequence[ClipResult]], metrics: Metrics, seed: int
) -> StepsCurve:
    """The scores of the model's row against the number of sampling steps, in what was measured."""
    measured = sweep[max(sweep)][0].values
    metrics = {name: metric for name, metric in metrics.items() if name in measured}
    rows = {steps: tabulate(sweep[steps], metrics)["model"] for steps in sorted(sweep)}
    most = rows[max(rows)]
    points = [
        StepsPoint(
            steps,
            {name: column.estimate(metrics[name], seed) for name, column in row.items()},
            {
                name: compare(column, most[name], metrics[name], seed).difference
                for name, column in row.items()
            },
        )
        for steps, row in rows.items()
    ]
    return StepsCurve(len(sweep[max(sweep)]), points)


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
        found[kind] = {name: _curve(row, name, m, frames) for name, m in metrics.items()}
    return found


def tabulate(results: Sequence[ClipResult], metrics: Metrics) -> Table:
    """Scores as arrays, clips in order of episode and start."""
    ordered = sorted(results, key=lambda r: (r.episode, r.start))
    table: dict[str, dict[str, Column]] = {}
    for kind in dict.fromkeys(r.kind for r in results):
        row = [r for r in ordered if r.kind == kind]
        clips = np.array([(r.episode, r.start) for r in row], np.int64)
        table[kind] = {
            name: Column(
                np.array([r.values[name] for r in row], np.float64),
                np.array([r.weights[name] for r in row], np.float64),
                clips,
                _features(row, name),
            )
            for name in metrics
        }
    return table


def _features(row: Sequence[ClipResult], name: str) -> NDArray[np.float32] | None:
    found = [r.features[name] for r in row if name in r.features]
    return np.array(found, np.float32) if found else None


@functools.lru_cache(maxsize=16)
def episode_resamples(episodes: tuple[int, ...], seed: int) -> NDArray[np.int64]:
    """How often each clip is drawn in bootstrap samples, `[RESAMPLES, N]`.

    Whole episodes are drawn with all their clips, because clips of one episode are alike: ten
    windows of it are no ten independent observations.

    Args:
        episodes: the episode of each clip, `[N]`.
        seed: of the draws.
    """
    different, place = np.unique(episodes, return_inverse=True)
    count = len(different)
    draws = np.random.default_rng(seed).integers(count, size=(RESAMPLES, count))
    own = draws + count * np.arange(RESAMPLES)[:, None]  # so that one count serves all samples
    return np.bincount(own.ravel(), minlength=RESAMPLES * count).reshape(RESAMPLES, count)[:, place]


def compare(model: Column, reference: Column, metric: Metric, seed: int) -> Paired:
    """The mean difference of pairs, with its interval, and how often the model is better.

    Pairs are the clips that have a score in both.
    """
    model, reference = in_common(model.defined(), reference.defined())
    equal = model.values == reference.values  # two perfect clips differ by nothing, not inf − inf
    with np.errstate(invalid="ignore"):
        difference = np.where(equal, 0.0, model.values - reference.values)
    if not len(difference):
        return Paired(Estimate(None), 0, 0)
    counts = episode_resamples(tuple(model.clips[:, 0].tolist()), seed)
    better = difference > 0 if metric.higher_is_better else difference < 0
    interval = _with_interval(float(difference.mean()), means(difference, counts))
    return Paired(interval, int(better.sum()), len(difference))


def in_common(one: Column, other: Column) -> tuple[Column, Column]:
    """The clips that both have, in the same order."""
    inside = [_among(one.clips, other.clips), _among(other.clips, one.clips)]
    return one.only(inside[0]), other.only(inside[1])


def _among(clips: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
    known: set[tuple[int, int]] = {(episode, start) for episode, start in others.tolist()}
    return np.array([(episode, start) in known for episode, start in clips.tolist()], np.bool_)


def means(values: NDArray[np.float64], weights: NDArray[Any]) -> NDArray[np.float64]:
    """The mean of `values` `[N]` by each row of `weights` `[R, N]`."""
    with np.errstate(invalid="ignore"):
        return (weights @ values) / weights.sum(1)


def _difference(near: Column, far: Column, metric: Metric, seed: int) -> Estimate:
    if isinstance(metric, SetMetric):
        return Estimate(finite(far.summary(metric) - near.summary(metric)))
    near, far = near.defined(), far.defined()
    with np.errstate(invalid="ignore"):
        spread = far.spread(metric, seed + 1) - near.spread(metric, seed)
        return _with_interval(far.summary(metric) - near.summary(metric), spread)


def _with_interval(value: float, spread: NDArray[np.float64]) -> Estimate:
    if not np.all(np.isfinite(spread)):
        return Estimate(finite(value))
    low, high = np.quantile(spread, INTERVAL)
    return Estimate(finite(value), finite(low), finite(high))


def _curve(row: Sequence[ClipResult], name: str, metric: Metric, frames: int) -> list[float | None]:
    """The summary at each frame over the clips that have a score there."""
    scores = np.full((len(row), frames), np.nan)
    for line, result in zip(scores, row, strict=True):
        line[: result.frames] = result.curves[name]
    weights = np.array([r.weights[name] for r in row], np.float64)
    defined = ~np.isnan(scores) & (weights > 0)[:, None]
    return [
        finite(metric.summarise(scores[held, frame], weights[held])) if held.any() else None
        for frame, held in enumerate(defined.T)
    ]
