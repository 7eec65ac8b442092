"""The rows of an evaluation, one per clip and predictor: ``episodes.parquet``."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from acwm_core.data.atomic import written_whole
from acwm_core.errors import DataError
from acwm_core.evaluation.results import FOLDER

EPISODES = "episodes.parquet"

CURVE, WEIGHT, FEATURES = "_per_frame", "_weight", "_features"
"""Endings of the Parquet columns beside that of a metric's values."""


@dataclass(frozen=True)
class ClipResult:
    """How well one row predicted one clip.

    Attributes:
        split: test split.
        episode: number of the episode within the split.
        start: the episode's frame that is the clip's first.
        ood_label: the factor that was shifted, if any.
        kind: the row, see `acwm_core.evaluation.protocol.Kind`.
        frames: length of the clip.
        values: the score of the clip, by metric; NaN where it is not defined.
        weights: how much the clip counts in a metric's summary, by metric.
        curves: the score of each frame, by metric; NaN where it is not defined. In the precision of
            float32, as they are written.
        features: of metrics that compare sets, see `acwm_core.metric.SetMetric`, `[2, D]`.
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


def write_results(path: Path, results: Sequence[ClipResult]) -> None:
    """Write one Parquet row per clip and row: per metric its value, weight and curve."""
    pa, pq = _pyarrow()
    metrics = list(results[0].values) if results else []
    columns: dict[str, Any] = {
        "split": [r.split for r in results],
        "episode": pa.array([r.episode for r in results], pa.int32()),
        "start": pa.array([r.start for r in results], pa.int32()),
        "ood_label": pa.array([r.ood_label for r in results], pa.string()),
        "kind": [r.kind for r in results],
        "frames": pa.array([r.frames for r in results], pa.int32()),
    }
    for name in metrics:
        columns[name] = pa.array([r.values[name] for r in results], pa.float64())
        weights = [r.weights[name] for r in results]
        columns[f"{name}{WEIGHT}"] = pa.array(weights, pa.float64())
        curves = [r.curves[name] for r in results]
        columns[f"{name}{CURVE}"] = pa.array(curves, pa.list_(pa.float32()))
    for name in dict.fromkeys(name for r in results for name in r.features):
        vectors = [r.features.get(name) for r in results]
        columns[f"{name}{FEATURES}"] = pa.array(vectors, pa.list_(pa.list_(pa.float32())))
    with written_whole(path) as partial:
        pq.write_table(pa.table(columns), partial, compression="zstd")


def read_results(run: Path) -> list[ClipResult]:
    """Read the rows of an evaluated run.

    Raises:
        DataError: there are none.
    """
    path = run / FOLDER / EPISODES
    if not path.exists():
        raise DataError(f"{run} was not evaluated: run `acwm evaluate {run}` first")
    return read_rows(path)


def read_rows(path: Path) -> list[ClipResult]:
    """Read what `write_results` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        DataError: it is damaged.
    """
    pa, pq = _pyarrow()
    try:
        rows: list[dict[str, Any]] = pq.read_table(path).to_pylist()
    except pa.ArrowInvalid as error:
        raise DataError(f"{path} is damaged ({error}): remove it and evaluate again") from error
    found: list[ClipResult] = []
    for row in rows:
        metrics = [name.removesuffix(CURVE) for name in row if name.endswith(CURVE)]
        found.append(
            ClipResult(
                split=row["split"],
                episode=row["episode"],
                start=row.get("start", 0),  # evaluations from before there were windows
                ood_label=row["ood_label"],
                kind=row["kind"],
                frames=row["frames"],
                values={name: row[name] for name in metrics},
                weights={name: row[f"{name}{WEIGHT}"] for name in metrics},
                curves={name: row[f"{name}{CURVE}"] for name in metrics},
                features={n: row[f"{n}{FEATURES}"] for n in metrics if row.get(f"{n}{FEATURES}")},
            )
        )
    return found


def _pyarrow() -> tuple[Any, Any]:
    """Arrow and its Parquet module, which carry no types."""
    return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
