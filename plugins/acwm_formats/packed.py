"""How much compressed bytes unpack to, measured without unpacking them to memory."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zlib
from collections.abc import Callable
from typing import Any

from acwm_core.arrays import LARGE, RATIO, check_unpacked

ZSTD, GZIP, BZIP2, XZ = b"\x28\xb5\x2f\xfd", b"\x1f\x8b", b"BZh", b"\xfd7zXZ"
ZLIB = (b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda")

BLOSC = b"\x02"
"""The version of its format; what a chunk unpacks to and its own length follow."""

SKIPPED = b"\x2a\x4d\x18"
"""What a frame of Zstandard that holds nothing begins with, behind its first byte."""

DEFLATED = 1032
"""How many times its size deflated data unpack to at most."""

BLOCK = 2**17
"""Bytes that a block of Zstandard unpacks to at most."""

PIECE = 2**20
"""Bytes that are unpacked at once, to be counted."""

ITEM = 8
"""Bytes in memory of each text in a list of texts, which takes four on the disk at least."""

_DAMAGED = (OSError, zlib.error, lzma.LZMAError, EOFError)


def check_packed(data: bytes | memoryview, codec: str = "", most: int | None = None) -> None:
    """Refuse compressed bytes that unpack to far more than they are; others pass.

    Args:
        data: the bytes.
        codec: how they were compressed, e.g. ``zstd``; what their first bytes say by default.
        most: how many bytes they may unpack to in any case.

    Raises:
        ValueError: they do, or were not compressed by the codec that is given.
    """
    room = max(LARGE, RATIO * len(data))
    limit = room if most is None else min(room, most)
    if (kind := codec or _codec_of(data)) not in _SIZES:
        return
    try:
        size = _SIZES[kind](data, limit)
    except _DAMAGED:
        if codec:
            raise
        return  # other bytes with the same beginning, or damage, which their reader reports
    check_unpacked(len(data), size)
    if most is not None and size > most:
        raise ValueError(f"{len(data):,} bytes unpack to more than the {most:,} that belong there")


def _codec_of(data: bytes | memoryview) -> str:
    """The codec that the first bytes are of; empty if of none."""
    head = bytes(data[:16])
    if head[:1] == BLOSC and int.from_bytes(head[12:], "little") == len(data):
        return "blosc"
    if head.startswith((GZIP, *ZLIB)) and len(data) * DEFLATED <= LARGE:
        return ""
    starts = {ZSTD: "zstd", GZIP: "gzip", BZIP2: "bz2", XZ: "lzma", **dict.fromkeys(ZLIB, "zlib")}
    return next((codec for start, codec in starts.items() if head.startswith(start)), "")


def zstd_size(data: bytes | memoryview) -> int:
    """An upper bound of what frames of Zstandard unpack to, by their headers and blocks."""
    place, total = 0, 0
    while place + 4 < len(data):
        if bytes(data[place + 1 : place + 4]) == SKIPPED:
            place += 8 + int.from_bytes(data[place + 4 : place + 8], "little")
            continue
        size, place = _zstd_frame(data, place)
        total += size
    return total


def _zstd_frame(data: bytes | memoryview, start: int) -> tuple[int, int]:
    """An upper bound of what one frame unpacks to, and where it ends."""
    flags = data[start + 4]
    single = flags >> 5 & 1
    place = start + 5 + (not single) + (0, 1, 2, 4)[flags & 3]
    width = (single, 2, 4, 8)[flags >> 6]
    claimed = int.from_bytes(data[place : place + width], "little")
    place, blocks, last = place + width, 0, False
    while place + 3 <= len(data) and not last:
        header = int.from_bytes(data[place : place + 3], "little")
        kind, size, last = header >> 1 & 3, header >> 3, bool(header & 1)
        blocks += size if kind < 2 else BLOCK  # as they are, or one byte repeated
        place += 3 + (1 if kind == 1 else size)
    return max(claimed, blocks), place + 4 * (flags >> 2 & 1)


def _claimed(start: int) -> Callable[[bytes | memoryview, int], int]:
    """Reads a size of four bytes in the header."""
    return lambda data, _: int.from_bytes(data[start : start + 4], "little")


def _streamed(opened: Callable[[Any], Any]) -> Callable[[bytes | memoryview, int], int]:
    """Counts what a file unpacks to, in pieces, until it is more than a limit."""

    def size(data: bytes | memoryview, limit: int) -> int:
        count = 0
        with opened(io.BytesIO(data)) as file:
            while count <= limit and (piece := file.read(PIECE)):
                count += len(piece)
        return count

    return size


def _zlib_size(data: bytes | memoryview, limit: int) -> int:
    unpacker, count, rest = zlib.decompressobj(), 0, bytes(data)
    while count <= limit and not unpacker.eof:
        count += len(piece := unpacker.decompress(rest, PIECE))
        rest = unpacker.unconsumed_tail
        if not piece and not rest:
            break
    return count


_SIZES: dict[str, Callable[[bytes | memoryview, int], int]] = {
    "blosc": _claimed(4),
    "lz4": _claimed(0),
    "zstd": lambda data, _: zstd_size(data),
    "zlib": _zlib_size,
    "gzip": _streamed(lambda file: gzip.GzipFile(fileobj=file)),
    "bz2": _streamed(bz2.BZ2File),
    "lzma": _streamed(lzma.LZMAFile),
    "vlenutf8": lambda data, _: ITEM * int.from_bytes(data[:4], "little"),
}
"""What bytes unpack to by the codec, which is only counted up to a limit."""
