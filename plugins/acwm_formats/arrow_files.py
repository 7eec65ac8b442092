"""How much the compressed buffers of an Arrow file unpack to, by what their headers claim."""

from __future__ import annotations

import importlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from acwm_core.arrays import check_unpacked

arrow: Any = importlib.import_module("pyarrow")  # it has no type annotations
ipc: Any = importlib.import_module("pyarrow.ipc")

_MAGIC = 8
"""Bytes before the first message."""

_CONTENT, _DATA, _BUFFERS, _COMPRESSION = 2, 1, 2, 3
"""Numbers of fields: of a message, of a batch of dictionaries, and two of a batch of records."""


def check_arrow(path: Path) -> None:
    """Refuse a file in the format of Arrow whose buffers unpack to far more than it stores.

    The library takes memory for what they claim, and refuses those that hold anything else.

    Raises:
        ValueError: they do.
    """
    check_unpacked(path.stat().st_size, sum(_claims(path)))


def _claims(path: Path) -> Iterator[int]:
    with arrow.memory_map(str(path)) as file:
        file.seek(_MAGIC)
        while True:
            try:
                message = ipc.read_message(file)
            except EOFError:
                return
            if message.type in ("record batch", "dictionary"):
                about = message.metadata.to_pybytes()
                batch = _reference(about, _field(about, _reference(about, 0), _CONTENT))
                if message.type == "dictionary":
                    batch = _reference(about, _field(about, batch, _DATA))
                yield from _unpacked(about, batch, message.body)


def _unpacked(about: bytes, batch: int, body: Any) -> Iterator[int]:
    """The lengths that the buffers of a batch claim, if they are compressed."""
    if not _field(about, batch, _COMPRESSION):
        return
    buffers = _reference(about, _field(about, batch, _BUFFERS))
    (count,) = struct.unpack_from("<I", about, buffers)
    for offset, length in struct.iter_unpack("<qq", about[buffers + 4 :][: 16 * count]):
        if length:
            yield max(0, *struct.unpack_from("<q", body, offset))


def _field(data: bytes, table: int, number: int) -> int:
    """Where a field of a table of FlatBuffers lies; 0 if it has none of this number."""
    fields = table - struct.unpack_from("<i", data, table)[0]
    (size,) = struct.unpack_from("<H", data, fields)
    place = 4 + 2 * number
    offset = struct.unpack_from("<H", data, fields + place)[0] if place < size else 0
    return table + offset if offset else 0


def _reference(data: bytes, place: int) -> int:
    return place + struct.unpack_from("<I", data, place)[0]
