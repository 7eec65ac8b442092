"""The files of a result: scores as Parquet, and all of them replaced at once or not at all.

``summary.json`` decides which result is there: readers see the whole old or the whole new one. The
other files of a new result wait in a folder whose name holds the hash of their summary. They become
valid at the moment that summary gets its final name.
"""

from __future__ import annotations

import contextlib
import importlib
import shlex
import shutil
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from acwm_core.data.shards import file_sha256
from acwm_core.errors import DataError
from acwm_core.evaluation.config import EvaluationConfig, setting_overrides
from acwm_core.evaluation.results import FOLDER, SUMMARY, VIDEOS, Score
from acwm_core.files import check_fetched, parse_json, written_whole
from acwm_core.recipe.former import current_settings

pa: Any = importlib.import_module("pyarrow")  # it has no type stubs
pq: Any = importlib.import_module("pyarrow.parquet")

EPISODES = "episodes.parquet"

WAITING = ".result-"

PLACE = {
    **dict.fromkeys(("split", "ood_label", "kind"), pa.string()),
    **dict.fromkeys(("episode", "start", "frames"), pa.int32()),
}
"""Types of the Parquet columns that identify the clip and row of the scores."""

CURVE, WEIGHT, FEATURES, SHARE = "_per_frame", "_weight", "_features", "_share"
"""Suffixes of a metric's further Parquet columns, beside the one with its values."""

WITHOUT_EFFECT = ("batch_size", "device")
"""Settings that change results only by rounding."""

OF_CURVES = ("steps_sweep", "sweep_episodes")
"""Settings of the curve of sampling steps, without effect on a result that has none."""

OF_SWEEPS = ("severity_episodes",)
"""Settings that an evaluation without ``--sweep`` does not use."""


def write_scores(path: Path, scores: Sequence[Score]) -> None:
    """Write one Parquet row per score, with value, weight, curve and share of each metric."""
    columns: dict[str, Any] = {
        name: pa.array([getattr(s, name) for s in scores], kind)
        for name, kind in {**PLACE, "failed": pa.bool_()}.items()
    }
    for name in scores[0].values if scores else ():
        columns |= {
            name: pa.array([s.values[name] for s in scores], pa.float64()),
            name + WEIGHT: pa.array([s.weights[name] for s in scores], pa.float64()),
            name + CURVE: pa.array([s.curves[name] for s in scores], pa.list_(pa.float32())),
        }
    for name in dict.fromkeys(name for s in scores for name in s.shares):
        columns[name + SHARE] = pa.array([s.shares.get(name) for s in scores], pa.float64())
    for name in dict.fromkeys(name for s in scores for name in s.features):
        vectors = [s.features.get(name) for s in scores]
        columns[name + FEATURES] = pa.array(vectors, pa.list_(pa.list_(pa.float32())))
    with written_whole(path) as partial:
        pq.write_table(
            pa.table(columns),
            partial,
            compression="zstd",
            use_dictionary=[name for name, kind in PLACE.items() if kind == pa.string()],
            use_byte_stream_split=[  # a third smaller
                f"{name}.list.element" for name in columns if name.endswith(CURVE)
            ],
        )


def read_scores(run: Path) -> list[Score]:
    """Read the scores of an evaluated run; `DataError` if there are none."""
    path = result_file(run / FOLDER, EPISODES)
    if not path.exists():
        raise DataError(
            f"{run} was not evaluated: run `acwm evaluate {shlex.quote(str(run))}` first"
        )
    return load_scores(path)


def load_scores(path: Path) -> list[Score]:
    """Read what `write_scores` wrote; `DataError` if it is damaged."""
    try:
        rows: list[dict[str, Any]] = pq.ParquetFile(path).read().to_pylist()
        names = [n.removesuffix(CURVE) for n in (rows[0] if rows else ()) if n.endswith(CURVE)]
        return [_score(row, names) for row in rows]
    except FileNotFoundError:
        raise
    except (pa.ArrowException, OSError, LookupError, TypeError, ValueError) as error:
        check_fetched(path)
        why = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise DataError(f"{path} is damaged ({why}): remove it and evaluate again") from error


def _score(row: Mapping[str, Any], names: Sequence[str]) -> Score:
    return Score(
        **{name: row.get(name, 0) for name in PLACE},  # old files without windows: start 0
        values={name: row[name] for name in names},
        weights={name: row[name + WEIGHT] for name in names},
        curves={name: row[name + CURVE] for name in names},
        features={n: row[n + FEATURES] for n in names if row.get(n + FEATURES)},
        failed=row.get("failed", False),
        shares={n: row[n + SHARE] for n in names if row.get(n + SHARE) is not None},
    )


def refuse_other_result(
    file: Path, config: EvaluationConfig, data: Mapping[str, str | None], free: Sequence[str] = ()
) -> None:
    """Refuse to replace a result that was made with other settings, or on other data.

    Args:
        file: the result file; a missing or unreadable one may be replaced.
        config: the current settings.
        data: checksums of the current splits. For a sweep: its values, with None because their
            data is not generated yet.
        free: further settings that may differ.

    Raises:
        DataError: settings or data differ; the message says how.
    """
    try:
        result = parse_json(file.read_bytes())
        facts = result["provenance"]
        there = current_settings(facts["evaluation"])
        checksums = dict[str, str](facts["dataset"]["checksums"])
        if not any(split.get("steps") for split in result.get("splits", {}).values()):
            free = (*free, *OF_CURVES)
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return
    now = {
        name: value
        for name, value in config.to_dict().items()
        if name not in (*WITHOUT_EFFECT, *free)
    }
    differences = setting_overrides(now, there)
    differences += [
        f"{name} of other data"
        for name, checksum in data.items()
        if checksum and checksums.get(name) != checksum
    ]
    differences += [name for name in checksums if name not in data]
    if differences:
        raise DataError(
            f"{file} holds a result made with {', '.join(differences)}: write to another folder "
            "with --out, or replace it with --overwrite"
        )


def result_file(folder: Path, name: str) -> Path:
    """Where the file `name` of the result in an evaluation folder is, or would be."""
    with contextlib.suppress(DataError):  # no summary
        waiting = _waiting(folder, folder / SUMMARY) / name
        if waiting.exists():
            return waiting
    return folder / name


@contextlib.contextmanager
def replacing_result(folder: Path) -> Generator[Path]:
    """Yield a folder to write a result to; afterwards it replaces the one in `folder` atomically.

    The caller must hold the lock of `folder`. If the block raises, the old result stays.
    """
    _settle(folder)
    new = folder / f"{WAITING}new"
    try:
        (new / VIDEOS).mkdir(parents=True)
        yield new
        waiting = _waiting(folder, new / SUMMARY)
        new.replace(waiting)
        (waiting / SUMMARY).replace(folder / SUMMARY)
    finally:
        _settle(folder)


def _waiting(folder: Path, summary: Path) -> Path:
    return folder / f"{WAITING}{file_sha256(summary)}"


def _settle(folder: Path) -> None:
    """Move waiting files to their final names, and remove files that belong to no result."""
    (folder / VIDEOS).mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(DataError):
        waiting = _waiting(folder, folder / SUMMARY)
        for file in [path for path in waiting.rglob("*") if path.is_file()]:
            file.replace(folder / file.relative_to(waiting))
    for left in folder.glob(f"{WAITING}*"):
        shutil.rmtree(left)
