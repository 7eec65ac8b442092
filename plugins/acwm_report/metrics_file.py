"""Curves of a run's `metrics.csv`, which may have millions of rows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow  # pyright: ignore[reportMissingTypeStubs]
from numpy.typing import NDArray
from pyarrow import compute, csv  # pyright: ignore

from acwm_core.files import check_fetched

# They have no types.
_arrow, _compute, _csv = cast(Any, pyarrow), cast(Any, compute), cast(Any, csv)

POINTS = 4000
"""Most points of a curve; of more, as many successive ones are averaged as makes it fewer."""

NUMBER = r"^\s*[-+]?(\d+\.?\d*([eE][-+]?\d+)?|\.\d+([eE][-+]?\d+)?|inf|nan)\s*$"


def logged(run: Path, column: str) -> tuple[list[float], list[float]]:
    """The steps at which a number was logged, and its values; empty if it never was.

    Rows that were cut off are left out.
    """
    file = run / "metrics.csv"
    if not file.exists():
        return [], []
    check_fetched(file)
    rows: NDArray[np.float64] = np.concatenate([np.zeros((0, 2)), *_chunks(file, column)])
    together = -(-len(rows) // POINTS)
    if together > 1:
        starts = np.arange(0, len(rows), together)
        counts = np.diff(starts, append=len(rows))
        rows = cast(Any, np.add).reduceat(rows, starts) / counts[:, None]
    return rows[:, 0].tolist(), rows[:, 1].tolist()


def _skip(row: Any) -> str:
    return "skip"


def _chunks(file: Path, column: str) -> Iterator[NDArray[np.float64]]:
    """Step and value of the rows that have both, `[n, 2]`, some thousands at a time."""
    columns = ["step", column]
    options = {
        "parse_options": _csv.ParseOptions(invalid_row_handler=_skip),
        "convert_options": _csv.ConvertOptions(
            include_columns=columns, column_types=dict.fromkeys(columns, _arrow.string())
        ),
    }
    try:
        for batch in _csv.open_csv(file, **options):
            yield _numbers(batch)
    except (_arrow.ArrowInvalid, _arrow.ArrowKeyError):  # it has no such column, or no row at all
        return


def _numbers(batch: Any) -> NDArray[np.float64]:
    kept: Any = None
    for column in batch.columns:
        is_number = _compute.match_substring_regex(column, NUMBER)
        kept = is_number if kept is None else _compute.and_(kept, is_number)
    sound = batch.filter(kept)
    trimmed = (_compute.utf8_trim_whitespace(column) for column in sound.columns)
    return np.stack(
        [each.cast(_arrow.float64()).to_numpy(zero_copy_only=False) for each in trimmed], 1
    )
