"""Chunks of HDF5 arrays, measured before the library unpacks them to whatever size they have."""

from __future__ import annotations

import itertools
import math
import zlib
from typing import Any

from acwm_core.arrays import LARGE
from acwm_formats.packed import DEFLATED, PIECE, check_packed

DEFLATE, LZF, SZIP = 1, 32000, 4
PLAIN = (2, 3, 5, 6)  # filters that keep the size or shorten it by a known number of bits

_SOUND: set[tuple[Any, ...]] = set()
"""Chunks that were measured, by their file, its array and the place there."""

_REMEMBERED = 10_000


def check_chunks(dataset: Any, rows: slice) -> None:
    """Refuse chunks of an array, in some of its rows, that unpack to more than a chunk holds.

    Raises:
        ValueError: one does; or they are compressed several times, so that nobody knows.
    """
    plist = dataset.id.get_create_plist() if dataset.chunks else None
    codes = [plist.get_filter(i)[0] for i in range(plist.get_nfilters())] if plist else []
    packing = [place for place, code in enumerate(codes) if code not in PLAIN]
    if len(packing) > 1:
        raise ValueError(f"{dataset.name} is compressed {len(packing)} times")
    if not packing or codes[packing[0]] in (LZF, SZIP):
        return
    least = LARGE // DEFLATED if codes[packing[0]] == DEFLATE else 0
    if dataset.id.get_storage_size() <= least:
        return
    for offset in _offsets(dataset, rows):
        stored = dataset.id.get_chunk_info_by_coord(offset)
        key = (dataset.file.filename, dataset.name, stored.byte_offset, stored.size)
        if stored.byte_offset is None or stored.size <= least or key in _SOUND:
            continue
        if not stored.filter_mask >> packing[0] & 1:
            _check(dataset, offset, deflated=least > 0)
        if len(_SOUND) >= _REMEMBERED:
            _SOUND.clear()
        _SOUND.add(key)


def _offsets(dataset: Any, rows: slice) -> Any:
    """Where the chunks begin that hold some rows."""
    start, stop, _ = rows.indices(len(dataset))
    first, *others = dataset.chunks
    ranges = [range(start // first * first, stop, first)]
    ranges += [range(0, size, step) for size, step in zip(dataset.shape[1:], others, strict=True)]
    return itertools.product(*ranges)


def _check(dataset: Any, offset: tuple[int, ...], *, deflated: bool) -> None:
    data: bytes = dataset.id.read_direct_chunk(offset)[1]
    if not deflated:
        check_packed(data)
        return
    most, count, unpacker = (
        math.prod(dataset.chunks) * dataset.dtype.itemsize,
        0,
        zlib.decompressobj(),
    )
    while data and count <= most:
        try:
            count += len(unpacker.decompress(data, PIECE))
        except zlib.error:
            return  # damage, which the library reports
        data = unpacker.unconsumed_tail
    if count > most:
        raise ValueError(f"a chunk of {dataset.name} unpacks to more than the {most:,} it holds")
