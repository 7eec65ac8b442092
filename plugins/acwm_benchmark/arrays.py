"""One array of an NPZ file, whose size is known before any of it is unpacked."""

from __future__ import annotations

import io
import lzma
import math
import tokenize
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError

HEADER = 16_384
"""Bytes at the start of an array within which its header ends."""

OVERHEAD = 2**20
"""Bytes by which a file may be larger than its array."""

UNREADABLE = (
    *(OSError, ValueError, EOFError, LookupError, TypeError, ArithmeticError, MemoryError),
    *(BadZipFile, zlib.error, lzma.LZMAError, RuntimeError, SyntaxError, tokenize.TokenError),
)
"""What `zipfile` and NumPy raise for a file that is no sound NPZ."""

Check = Callable[[tuple[int, ...], "np.dtype[Any]"], None]


def read_array(path: Path, name: str, check: Check, most_bytes: int) -> NDArray[Any]:
    """Read the array `name`, the only one of an NPZ file.

    Args:
        check: called with shape and dtype before anything is unpacked; raises a `DataError` if they
            are not those wanted.
        most_bytes: size of the largest array that is wanted; a file that is much larger is refused.

    Raises:
        DataError: it is damaged, or holds something else or more.
    """
    if path.stat().st_size > most_bytes + OVERHEAD:
        raise DataError(
            f"{path.name} has {path.stat().st_size:,} bytes, more than the {most_bytes:,} that are "
            "asked for"
        )
    try:
        with ZipFile(path) as archive:
            names = archive.namelist()
            if names != [f"{name}.npy"]:
                listed = ", ".join(map(_what, names[:3]))
                more = ", …" if len(names) > 3 else ""
                raise DataError(f"{path.name} holds {listed or 'nothing'}{more}, not {name!r}")
            with archive.open(names[0]) as file:
                return _array(file, check)
    except UNREADABLE as error:
        why = f"{error!s:.200}" or type(error).__name__
        raise DataError(f"{path.name} cannot be read ({why})") from error


def _what(member: str) -> str:
    return member.removesuffix(".npy") if member.endswith(".npy") else f"{member!r}, no array"


def _array(file: Any, check: Check) -> NDArray[Any]:
    start = io.BytesIO(file.read(HEADER))
    major, _ = np.lib.format.read_magic(start)
    readers = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
    if major not in readers:
        raise ValueError(f"version {major} of NumPy's format")
    shape, in_columns, dtype = readers[major](start)
    if min(shape, default=0) < 0 or dtype.kind not in "biuf":
        raise ValueError(f"{dtype} of shape {shape} is no array of numbers")
    check(shape, dtype)
    size = math.prod(shape) * dtype.itemsize
    data = start.read()
    data += file.read(max(0, size - len(data)) + 1)  # one more ends in the checksum
    if len(data) != size:
        raise ValueError(f"it has {'more' if len(data) > size else 'less'} than its header says")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if in_columns else "C")
