"""The scores of clips, one row per clip and predictor: ``episodes.parquet``, and their summary."""

from __future__ import annotations

import importlib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from acwm_core.data.atomic import written_whole
from acwm_core.errors import DataError
from acwm_core.evaluation.metric import Metric, SetMetric
from acwm_core.evaluation.replacing import result_file
from acwm_core.evaluation.results import FOLDER, Scores, SplitSummary, StepsCurve, StepsPoint
from acwm_core.evaluation.statistics import (
    ClipScores,
    Estimate,
    Paired,
    Summarise,
    compare,
    finite,
    gap_between,
)
from acwm_core.untrusted import most_values, printable

pa: Any = importlib.import_module("pyarrow")  # it has no type stubs
pq: Any = importlib.import_module("pyarrow.parquet")

EPISODES = "episodes.parquet"

INT, TEXT, TRUTH = pa.int32(), pa.string(), pa.bool_()
PLACE = dict(split=TEXT, episode=INT, start=INT, ood_label=TEXT, kind=TEXT, frames=INT)
"""Types of the Parquet columns that identify the clip and row of the scores."""

CURVE, WEIGHT, FEATURES = "_per_frame", "_weight", "_features"
"""Suffixes of a metric's further Parquet columns, beside the one with its values."""

MAX_TEXT = 1000
"""Maximum number of characters of a text in a row."""

Metrics = Mapping[str, Metric]


@dataclass(frozen=True)
class ClipResult:
    """How well one row predicted one clip.

    Attributes:
        split: test split.
        episode: number of the episode within the split.
        start: the episode's frame with which the clip starts.
        ood_label: the factor that was shifted, if any.
        kind: the row, see `acwm_core.evaluation.clips.Predictor`.
        frames: length of the clip.
        values: the score of the clip, by metric; NaN where it is not defined.
        weights: how much the clip counts in a metric's summary, by metric.
        curves: the score of each frame, by metric; NaN where it is not defined. Rounded to float32,
            as they are written.
        features: features `[2, D]` of metrics that compare sets, see `SetMetric`.
        failed: whether the prediction is not finite; then all scores are `Metric.worst`.
    """

    split: str
    episode: int
    start: int
    ood_label: str | None
    kind: str
    frames: int
    values: dict[str, float]
    weights: dict[str, float]
    curves: dict[str, list[float]]
    features: dict[str, list[list[float]]] = field(default_factory=dict[str, list[list[float]]])
    failed: bool = False


def write_results(path: Path, results: Sequence[ClipResult]) -> None:
    """Write one Parquet row per result, with the value, weight and curve of each metric."""
    columns: dict[str, Any] = {
        name: pa.array([getattr(r, name) for r in results], kind)
        for name, kind in {**PLACE, "failed": TRUTH}.items()
    }
    for name in results[0].values if results else ():
        columns |= {
            name: pa.array([r.values[name] for r in results], pa.float64()),
            name + WEIGHT: pa.array([r.weights[name] for r in results], pa.float64()),
            name + CURVE: pa.array([r.curves[name] for r in results], pa.list_(pa.float32())),
        }
    for name in dict.fromkeys(name for r in results for name in r.features):
        vectors = [r.features.get(name) for r in results]
        columns[name + FEATURES] = pa.array(vectors, pa.list_(pa.list_(pa.float32())))
    with written_whole(path) as partial:
        curves = [f"{name}.list.element" for name in columns if name.endswith(CURVE)]
        pq.write_table(
            pa.table(columns),
            partial,
            compression="zstd",
            use_dictionary=[name for name, kind in PLACE.items() if kind == TEXT],
            use_byte_stream_split=curves,  # a third smaller
        )


def read_results(run: Path) -> list[ClipResult]:
    """Read the results of an evaluated run; `DataError` if there are none."""
    path = result_file(run / FOLDER, EPISODES)
    if not path.exists():
        raise DataError(f"{run} was not evaluated: run `acwm evaluate {run}` first")
    return read_rows(path)


def read_rows(path: Path) -> list[ClipResult]:
    """Read what `write_results` wrote; `DataError` if it is damaged."""
    try:
        return _results(_read_table(path).to_pylist())
    except FileNotFoundError:
        raise
    except (pa.ArrowException, OSError, LookupError, TypeError, ValueError) as error:
        why = " ".join(printable(f"{type(error).__name__}: {error}").split())[:200]
        raise DataError(f"{path} is damaged ({why}): remove it and evaluate again") from error


def _read_table(path: Path) -> Any:
    """Read a table and check its types, and that it is not far larger than its file suggests.

    Raises:
        ValueError, an error of Arrow: a check failed.
    """
    most = most_values(path)
    texts = [name for name, kind in PLACE.items() if kind == TEXT]
    with pq.ParquetFile(path, read_dictionary=texts) as file:  # keeps one copy of each text
        for field in file.schema_arrow:  # other texts could be long, and repeated in every row
            if field.name not in texts and re.search("string|binary", str(field.type)):
                raise ValueError(f"{printable(field.name)[:80]} is text")
        batches, held = list[Any](), 0
        for batch in file.iter_batches(1024):
            for name in {*texts} & {*batch.schema.names}:
                known: Any = getattr(batch[name], "dictionary", None)
                listed: list[str | None] = known.to_pylist() if known is not None else []
                for text in filter(None, listed):
                    if printable(text) != text or len(text) > MAX_TEXT:
                        raise ValueError(f"{name} is {printable(text)[:80]!r}")
            held += batch.nbytes
            if held > 8 * most:
                raise ValueError(f"it stands for more than {held} bytes")
            batches.append(batch)
        table = pa.Table.from_batches(batches, None if batches else file.schema_arrow)
    _check_types(table)
    return table


def _check_types(table: Any) -> None:
    for name, kind in PLACE.items():
        if name in table.column_names:  # old files without windows have no column `start`
            column = table[name].cast(kind)
            if name != "ood_label" and column.null_count:
                raise ValueError(f"{name} has gaps")
    for name in table.column_names:
        if name in PLACE or name.endswith(FEATURES):
            continue
        table[name].cast(pa.list_(pa.float32()) if name.endswith(CURVE) else pa.float64())
        if table[name].null_count:
            raise ValueError(f"{name} has gaps")


def _results(rows: list[dict[str, Any]]) -> list[ClipResult]:
    names = [name.removesuffix(CURVE) for name in (rows[0] if rows else ()) if name.endswith(CURVE)]
    return [
        ClipResult(
            **{name: row.get(name, 0) for name in PLACE},  # old files without windows: start 0
            values={name: row[name] for name in names},
            weights={name: row[name + WEIGHT] for name in names},
            curves={name: row[name + CURVE] for name in names},
            features={n: row[n + FEATURES] for n in names if row.get(n + FEATURES)},
            failed=row.get("failed", False),
        )
        for row in rows
    ]


def summarise_split(
    results: Sequence[ClipResult],
    metrics: Metrics,
    seed: int,
    sweep: Mapping[int, Sequence[ClipResult]] | None = None,
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


def summarise(results: Sequence[ClipResult], metrics: Metrics, seed: int) -> Scores:
    """Scores of a set of clips, with confidence intervals."""
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
    return Scores(len(model), rows, paired, len({r.episode for r in model}), dict(failed), left_out)


def steps_curve(
    sweep: Mapping[int, Sequence[ClipResult]], metrics: Metrics, seed: int
) -> StepsCurve:
    """The model's scores against the number of sampling steps, in the metrics measured there."""
    measured = sweep[max(sweep)][0].values
    metrics = {name: metric for name, metric in metrics.items() if name in measured}
    rows = {steps: tabulate(sweep[steps], metrics)["model"] for steps in sorted(sweep)}
    points: list[StepsPoint] = []
    for steps, row in rows.items():
        beyond = _compared(row, rows[max(rows)], metrics, seed)
        change = {name: each.difference for name, each in beyond.items()}
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
    inside: Sequence[ClipResult], outside: Sequence[ClipResult], metrics: Metrics, seed: int
) -> dict[str, dict[str, Estimate]]:
    """Scores out of distribution minus those in distribution, by row and metric."""
    near, far = tabulate(inside, metrics), tabulate(outside, metrics)
    return {
        kind: {name: gap_between(near[kind][name], far[kind][name], seed) for name in metrics}
        for kind in near
    }


def horizon(
    results: Sequence[ClipResult], metrics: Metrics
) -> dict[str, dict[str, list[float | None]]]:
    """The score of each frame summarised over clips, by row and metric; None where undefined."""
    frames = max(r.frames for r in results)
    kinds = dict.fromkeys(r.kind for r in results)
    rows = {kind: [r for r in results if r.kind == kind] for kind in kinds}
    return {
        kind: {name: _curve(row, name, metric, frames) for name, metric in metrics.items()}
        for kind, row in rows.items()
    }


def tabulate(results: Sequence[ClipResult], metrics: Metrics) -> dict[str, dict[str, ClipScores]]:
    """Scores as arrays by row and metric, with clips sorted by episode and start."""
    ordered = sorted(results, key=lambda r: (r.episode, r.start))
    return {
        kind: {
            name: scores_of([r for r in ordered if r.kind == kind], name, metric)
            for name, metric in metrics.items()
        }
        for kind in dict.fromkeys(r.kind for r in results)
    }


def scores_of(row: Sequence[ClipResult], name: str, metric: Metric) -> ClipScores:
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


def _curve(row: Sequence[ClipResult], name: str, metric: Metric, frames: int) -> list[float | None]:
    scores = np.full((len(row), frames), np.nan)
    for line, result in zip(scores, row, strict=True):
        line[: result.frames] = result.curves[name]
    weights = np.array([r.weights[name] for r in row], np.float64)
    defined = ~np.isnan(scores) & (weights > 0)[:, None]
    return [
        finite(metric.summed_up(scores[held, frame], weights[held])) if held.any() else None
        for frame, held in enumerate(defined.T)
    ]
