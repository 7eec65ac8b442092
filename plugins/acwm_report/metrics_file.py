"""Curves of a run's `metrics.csv`, which may have millions of rows."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pyarrow import csv

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
    parts = [np.zeros((0, 2)), *_chunks(file, column)]
    rows = np.concatenate(parts)
    together = -(-len(rows) // POINTS) or 1
    starts = np.arange(0, len(rows), together)
    counts = np.diff([*starts, len(rows)])
    means = np.add.reduceat(rows, starts) / counts[:, None] if together > 1 else rows
    return means[:, 0].tolist(), means[:, 1].tolist()


def _chunks(file: Path, column: str) -> Iterator[NDArray[np.float64]]:
    """Step and value of the rows that have both, `[n, 2]`, some thousands at a time."""
    library = cast(Any, csv)
    columns = ["step", column]
    options = {
        "parse_options": library.ParseOptions(invalid_row_handler=lambda row: "skip"),
        "convert_options": library.ConvertOptions(
            include_columns=columns, column_types=dict.fromkeys(columns, pa.string())
        ),
    }
    try:
        for batch in library.open_csv(file, **options):
            yield _numbers(batch)
    except (pa.ArrowInvalid, pa.ArrowKeyError):  # it has no such column, or no row at all
        return


def _numbers(batch: Any) -> NDArray[np.float64]:
    library, kept = cast(Any, pc), None
    for column in batch.columns:
        is_number = library.match_substring_regex(column, NUMBER)
        kept = is_number if kept is None else library.and_(kept, is_number)
    sound = batch.filter(kept)
    trimmed = (library.utf8_trim_whitespace(column) for column in sound.columns)
    return np.stack([each.cast(pa.float64()).to_numpy(zero_copy_only=False) for each in trimmed], 1)
