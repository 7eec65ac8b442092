"""What the header of an MP4 or MOV file claims, looked at before FFmpeg believes it.

FFmpeg makes an index of as many samples as are claimed, which a few bytes can do: a sample of a
constant size, or of the fragment's default size, takes none of the header.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from acwm_core.errors import DataError

HOLDERS = frozenset(
    b"moov trak mdia minf stbl edts mvex moof traf udta meta dinf wave sinf schi ipro tapt tref "
    b"gmhd free skip".split()
)
"""Boxes that hold others."""

DEEPEST = 12
"""Boxes within boxes; a sound file has 7."""

MOST_EDITS, MOST_SHOWN = 1000, 10**6
"""Edits of a track, and samples that they may always show; a sound file has an edit or two."""

PER_SAMPLE = 0xF00
"""Flags of a fragment whose samples have numbers of their own, which take bytes."""


class Box(NamedTuple):
    """A part of the file: its type, where its content begins, and where it ends."""

    kind: bytes
    start: int
    stop: int


def check_mp4(path: Path) -> None:
    """Refuse an MP4 or MOV file that claims more samples than it has bytes.

    Other damage is left to FFmpeg.

    Raises:
        DataError: it does, or its header is compressed, which nothing has written for 20 years.
    """
    size = path.stat().st_size
    edits, samples, in_fragments = 0, 0, 0
    with path.open("rb") as file:
        for box in _boxes(file, 0, size):
            if box.kind == b"cmov":
                raise DataError(f"{path} has a compressed header: write it again as MP4")
            if box.kind == b"trak":
                edits = samples = 0
            claimed = _claimed(file, box)
            in_fragments += claimed if box.kind == b"trun" else 0
            edits = claimed if box.kind == b"elst" else edits
            samples = claimed if box.kind == b"stsz" else samples
            if edits > MOST_EDITS:
                raise DataError(f"{path} has {edits:,} edits: write it again without an edit list")
            frames_of_edits = edits * samples if edits * samples > MOST_SHOWN else 0
            if (most := max(claimed, in_fragments, frames_of_edits)) > size:
                raise DataError(f"{path} claims {most:,} frames, and has {size:,} bytes")


def _boxes(file: IO[bytes], start: int, stop: int, depth: int = 0) -> Iterator[Box]:
    """The boxes between two places, each before those that it holds."""
    while start + 8 <= stop:
        file.seek(start)
        head = file.read(16)
        if len(head) < 8:
            return
        size, kind, begin = int.from_bytes(head[:4]), head[4:8], 8
        if size == 1 and len(head) == 16:
            size, begin = int.from_bytes(head[8:]), 16
        end = min(stop, start + size) if size else stop
        if end < start + begin:
            return
        yield Box(kind, start + begin, end)
        if kind in HOLDERS and depth < DEEPEST:
            begin += 4 if kind == b"meta" else 0
            yield from _boxes(file, start + begin, end, depth + 1)
        start = end


def _claimed(file: IO[bytes], box: Box) -> int:
    """How many samples, or edits, a box claims that need no bytes of its own; 0 for other boxes."""
    if box.kind not in (b"stsz", b"stts", b"ctts", b"stsc", b"trun", b"elst"):
        return 0
    file.seek(box.start)
    head = file.read(12)
    if len(head) < 12:
        return 0
    first, second = struct.unpack(">II", head[4:])
    if box.kind == b"stsz":
        return second
    if box.kind == b"trun":
        return 0 if int.from_bytes(head[1:4]) & PER_SAMPLE else first
    if box.kind == b"elst":
        return first
    width = 3 if box.kind == b"stsc" else 2
    file.seek(box.start + 8)
    table = file.read(box.stop - box.start - 8)
    rows = np.frombuffer(table[: len(table) // (4 * width) * 4 * width], ">u4").reshape(-1, width)
    counts = rows[:first, width - 2].astype(np.int64)  # of samples per chunk, or per duration
    return int(counts.max(initial=0) if box.kind == b"stsc" else counts.sum())
