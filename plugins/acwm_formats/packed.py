"""How much compressed bytes unpack to, measured without unpacking them to memory."""

from __future__ import annotations

import bz2
import lzma
import zlib
from typing import Any

from acwm_core.arrays import LARGE, RATIO, check_unpacked

ZSTD, GZIP, BZIP2, XZ = b"\x28\xb5\x2f\xfd", b"\x1f\x8b", b"BZh", b"\xfd7zXZ"
ZLIB = (b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda")

BLOSC = b"\x02"
"""The version of its format; what a chunk unpacks to and its own length follow."""

DEFLATED = 1032
"""How many times its size deflated data unpack to at most."""

BLOCK = 2**17
"""Bytes that a block of Zstandard unpacks to at most."""

PIECE = 2**20
"""Bytes that are unpacked at once, to be counted."""


def check_packed(data: bytes | memoryview) -> None:
    """Refuse compressed bytes that unpack to far more than they are; others pass.

    Raises:
        ValueError: they do.
    """
    head = bytes(data[:16])
    if head[:1] == BLOSC and int.from_bytes(head[12:], "little") == len(data):
        check_unpacked(len(data), int.from_bytes(head[4:8], "little"))
    elif head.startswith(ZSTD):
        check_unpacked(len(data), zstd_size(data))
    elif head.startswith((GZIP, *ZLIB)) and len(data) * DEFLATED > LARGE:
        _check_counted(data, zlib.decompressobj(47))
    elif head.startswith(BZIP2):
        _check_counted(data, bz2.BZ2Decompressor())
    elif head.startswith(XZ):
        _check_counted(data, lzma.LZMADecompressor())


def zstd_size(data: bytes | memoryview) -> int:
    """An upper bound of what a frame of Zstandard unpacks to, by its header and its blocks."""
    flags = data[4] if len(data) > 4 else 0
    single = flags >> 5 & 1
    start = 5 + (not single) + (0, 1, 2, 4)[flags & 3]
    width = (single, 2, 4, 8)[flags >> 6]
    claimed = int.from_bytes(data[start : start + width], "little")
    place, blocks = start + width, 0
    while place + 3 <= len(data):
        header = int.from_bytes(data[place : place + 3], "little")
        kind, size = header >> 1 & 3, header >> 3
        blocks += size if kind < 2 else BLOCK  # as they are, or one byte repeated
        place += 3 + (1 if kind == 1 else size)
        if header & 1:
            break
    return max(claimed, blocks)


def _check_counted(data: bytes | memoryview, unpacker: Any) -> None:
    most, count, rest = max(LARGE, RATIO * len(data)), 0, bytes(data)
    try:
        while count <= most and not unpacker.eof:
            count += len(piece := unpacker.decompress(rest, PIECE))
            rest = unpacker.unconsumed_tail if hasattr(unpacker, "unconsumed_tail") else b""
            if not piece and not rest:
                break
    except (OSError, zlib.error, lzma.LZMAError, EOFError):
        return  # other bytes that begin alike, or damage, which whoever reads them reports
    check_unpacked(len(data), count)
