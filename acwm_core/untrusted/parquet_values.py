"""Check that a Parquet file claims no more values and bytes than a file of its size may hold.

Arrow crashes on forged metadata, so the metadata (in Thrift's compact protocol) is read here first.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import IO, Any

MAX_PACKED, MAX_VALUES = 16, 2**22
"""Limit on values: `MAX_PACKED` per byte of the file, plus `MAX_VALUES`. Measured numbers hardly
compress, whereas a small forged file could unpack to a disk full of zeros."""

MAX_BYTES, MAX_FOOTER, MAX_DEPTH = 8, 2**23, 20
"""Limits: bytes per value, bytes of the metadata, and its nesting depth."""


def most_values(path: Path) -> int:
    """The most values that the Parquet file `path` may hold, with all its pages unpacked.

    Raises:
        ValueError: it claims more, or is not a regular file or not a Parquet file.
        OSError: it cannot be read.
    """
    if not path.is_file():
        raise ValueError("it is not a regular file")
    size = path.stat().st_size
    most = MAX_PACKED * size + MAX_VALUES
    try:
        with path.open("rb") as file:
            chunks = [chunk[3] for group in _footer(file, size)[4] for chunk in group[1]]
            claimed, packed = (sum(chunk[field] for chunk in chunks) for field in (5, 7))
            held = sum(_unpacked(file, chunk) for chunk in chunks) if packed <= size else 0
    except (LookupError, TypeError) as error:
        raise ValueError(f"it is not a Parquet file ({type(error).__name__}: {error})") from None
    if claimed > most or packed > size or held > MAX_BYTES * most:
        raise ValueError(f"it claims {claimed} values, {packed} and {held} bytes, in {size}")
    return most


def _footer(file: IO[bytes], size: int) -> dict[int, Any]:
    file.seek(max(0, size - 8))
    length = int.from_bytes(file.read(4), "little")
    if file.read(4) != b"PAR1" or not 0 < length <= min(size - 8, MAX_FOOTER):
        raise ValueError("it is not a Parquet file")
    file.seek(size - 8 - length)
    return _struct(io.BytesIO(file.read(length)))


def _unpacked(file: IO[bytes], chunk: dict[int, Any]) -> int:
    """Unpacked bytes of a column chunk, from its page headers, because the footer may lie."""
    place, held = min(chunk[9], chunk.get(11) or chunk[9]), 0
    end = place + chunk[7]
    while place < end:
        file.seek(place)
        page = _struct(file)
        held += abs(page[2])
        place = file.tell() + max(0, page[3])
    return held


def _struct(file: IO[bytes], depth: int = 0) -> dict[int, Any]:
    """Read a Thrift struct: its values by field number."""
    found, field = dict[int, Any](), 0
    while head := file.read(1)[0]:
        field = field + (head >> 4) if head >> 4 else _value(file, 4, depth)
        found[field] = _value(file, head & 15, depth) if head & 15 > 2 else head & 15 == 1
    return found


def _value(file: IO[bytes], kind: int, depth: int) -> Any:
    if depth > MAX_DEPTH or kind not in (*range(1, 11), 12):
        raise ValueError("it is not a Parquet file")
    if kind <= 3:  # in a list, a boolean takes a byte
        return file.read(1)[0]
    if kind <= 6:
        packed = _varint(file)
        return packed >> 1 ^ -(packed & 1)
    if kind == 12:
        return _struct(file, depth + 1)
    if kind > 8:
        head = file.read(1)[0]
        count = head >> 4 if head >> 4 < 15 else _varint(file)
        return [_value(file, head & 15, depth + 1) for _ in range(count)]
    found = file.read(size := 8 if kind == 7 else min(_varint(file), MAX_FOOTER))
    return found if len(found) == size else found[size]  # raises IndexError if cut off


def _varint(file: IO[bytes]) -> int:
    found = shift = 0
    while (byte := file.read(1)[0]) > 127 and shift < 63:
        found, shift = found | (byte & 127) << shift, shift + 7
    return found | byte << shift
