"""Parquet: no more values, and no more bytes, than a file of its size may hold."""

from __future__ import annotations

import io
from pathlib import Path
from typing import IO, Any

from acwm_core.untrusted.thrift_values import Struct, Thrift

MAX_PACKED, MAX_VALUES = 16, 2**22
"""How many values a byte of a file may stand for, and a file of any size: measured numbers hardly
compress, and a small forged file could stand for a disk full of zeros."""

MAX_BYTES = 8
"""Of a value."""

MAX_FOOTER = 2**23
"""Bytes of what a file says of itself."""

MAGIC = b"PAR1"


def most_values(path: Path) -> int:
    """How many values the Parquet file `path` may hold, with all its pages unpacked.

    Raises:
        ValueError: it claims more, or is no plain file, or none of Parquet.
        OSError: it cannot be read.
    """
    if not path.is_file():
        raise ValueError("it is no plain file")
    size = path.stat().st_size
    most = MAX_PACKED * size + MAX_VALUES
    try:
        with path.open("rb") as file:
            chunks = [chunk[3] for group in _footer(file, size)[4] for chunk in group[1]]
            claimed = sum(chunk[5] for chunk in chunks)
            if sum(chunk[7] for chunk in chunks) > size:
                raise ValueError("its columns take more bytes than it has")
            held = sum(_unpacked(file, chunk) for chunk in chunks)
    except (LookupError, TypeError) as error:
        raise ValueError(f"it is no Parquet file ({type(error).__name__}: {error})") from None
    if claimed > most:
        raise ValueError(f"it claims {claimed} values in {size} bytes")
    if held > MAX_BYTES * most:
        raise ValueError(f"it stands for {held} bytes in {size}")
    return most


def _footer(file: IO[bytes], size: int) -> Struct:
    file.seek(max(0, size - 8))
    tail = file.read(8)
    length = int.from_bytes(tail[:4], "little")
    if tail[4:] != MAGIC or not 0 < length <= min(size - 8, MAX_FOOTER):
        raise ValueError("it is no Parquet file")
    file.seek(size - 8 - length)
    return Thrift(io.BytesIO(file.read(length))).struct()


def _unpacked(file: IO[bytes], chunk: Any) -> int:
    """Bytes of the pages of a column's chunk, as they say themselves: the footer may lie."""
    place, held = min(chunk[9], chunk.get(11) or chunk[9]), 0
    end = place + chunk[7]
    if not 0 <= place <= end:
        raise ValueError("it has pages outside the file")
    while place < end:
        file.seek(place)
        page = Thrift(file).struct()
        if page[2] < 0 or page[3] < 0:
            raise ValueError("it has a page of less than no bytes")
        held += page[2]
        place = file.tell() + page[3]
    return held
