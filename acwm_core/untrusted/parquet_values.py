"""Parquet: no more values than a file of its size may hold."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

MAX_PACKED, MAX_VALUES = 16, 2**22
"""How many values a byte of a file may stand for, and a file of any size: measured numbers hardly
compress, and a small forged file could stand for a disk full of zeros."""


def most_values(path: Path) -> int:
    """How many values the Parquet file `path` may hold.

    Raises:
        ValueError: it claims more, or is no plain file.
        OSError, an error of Arrow: it cannot be read.
    """
    if not path.is_file():
        raise ValueError("it is no plain file")
    most = MAX_PACKED * path.stat().st_size + MAX_VALUES
    parquet: Any = importlib.import_module("pyarrow.parquet")  # it has no types
    with parquet.ParquetFile(path) as file:
        facts = file.metadata
        groups = [facts.row_group(number) for number in range(facts.num_row_groups)]
        columns = range(facts.num_columns)
        claimed = sum(group.column(number).num_values for group in groups for number in columns)
    if claimed > most:
        raise ValueError(f"it claims {claimed} values in {path.stat().st_size} bytes")
    return most
