"""Arrays in ``.npy`` and ``.npz`` files, which hold what their headers claim and run no code."""

from __future__ import annotations

import functools
import io
import lzma
import math
import os
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

LARGE, RATIO = 2**28, 200
"""Bytes that a small file may always unpack to, and how many times its size beyond them."""

_LONGEST_HEADER = 2**14
"""Bytes at the start of an array within which its header ends; NumPy's are of 10,000 at most."""

_DAMAGED = (ArithmeticError, RecursionError, MemoryError, SyntaxError, TypeError)
"""What parsing a header raises besides `ValueError`."""

_UNSOUND = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, RuntimeError, LookupError)
"""What `zipfile` raises for an archive that is damaged or encrypted."""

_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def check_unpacked(stored: int, unpacked: int) -> None:
    """Refuse data that unpack to so much more than is stored that they can only do harm.

    Args:
        stored: bytes on the disk.
        unpacked: bytes in memory.

    Raises:
        ValueError: they do; says how many bytes.
    """
    if unpacked > max(LARGE, RATIO * stored):
        raise ValueError(f"{stored:,} bytes claim to hold {unpacked:,}")


def read_npy(file: IO[bytes], size: int, check: Callable[..., None] | None = None) -> NDArray[Any]:
    """The array in a ``.npy`` file that has `size` bytes from where `file` is.

    Args:
        check: called with its shape and dtype before it is unpacked; raises if it is not wanted.

    Raises:
        ValueError: it is damaged, claims more than there is, or holds objects or structures.
    """
    try:
        start = file.tell()
        head = io.BytesIO(file.read(_LONGEST_HEADER))
        version = np.lib.format.read_magic(head)
        if version not in _HEADERS:
            raise ValueError("its arrays are not plain numbers")
        shape, _, dtype = _HEADERS[version](head)
        if dtype.hasobject or dtype.names or not dtype.itemsize:
            raise ValueError(f"it holds {dtype}, not plain numbers or text")
        needed, there = math.prod(shape) * dtype.itemsize, size - head.tell()
        if min(shape, default=0) < 0 or needed > there:
            raise ValueError(f"it claims to hold {list(shape)} {dtype}, and has {there:,} bytes")
        if check is not None:
            check(shape, dtype)
        file.seek(start)
        return np.lib.format.read_array(file, allow_pickle=False)
    except (*_DAMAGED, tokenize.TokenError) as error:
        raise ValueError(f"its header is damaged ({type(error).__name__})") from error


def from_npy(data: bytes) -> NDArray[Any]:
    """The array in the bytes of a ``.npy`` file; raises as `read_npy`."""
    return read_npy(io.BytesIO(data), len(data))


def load_npy(path: Path) -> NDArray[Any]:
    """The array in a ``.npy`` file; raises as `read_npy`, and `OSError`."""
    with path.open("rb") as file:
        return read_npy(file, os.fstat(file.fileno()).st_size)


def load_npz(path: Path, check: Callable[..., None] | None = None) -> dict[str, NDArray[Any]]:
    """The arrays in an ``.npz`` file by name.

    Args:
        check: called with name, shape and dtype of each before it is unpacked; raises if it is not
            wanted.

    Raises:
        ValueError: it is damaged, unpacks to far more than it stores, or a member is no array, or
            holds more.
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        return _read_npz(file, os.fstat(file.fileno()).st_size, check)


def from_npz(data: bytes) -> dict[str, NDArray[Any]]:
    """The arrays in the bytes of an ``.npz`` file, by name; raises as `load_npz`."""
    return _read_npz(io.BytesIO(data), len(data))


def _read_npz(
    file: IO[bytes], size: int, check: Callable[..., None] | None = None
) -> dict[str, NDArray[Any]]:
    arrays: dict[str, NDArray[Any]] = {}
    try:
        with zipfile.ZipFile(file) as archive:
            members = archive.infolist()
            check_unpacked(size, sum(member.file_size for member in members))
            for member in members:
                name = member.filename.removesuffix(".npy")
                if name == member.filename or name in arrays:
                    why = "occurs twice" if name in arrays else "is no array"
                    raise ValueError(f"its member {member.filename} {why}")
                with archive.open(member) as opened:
                    named = functools.partial(check, name) if check else None
                    arrays[name] = read_npy(opened, member.file_size, named)
                    if opened.read(1):
                        raise ValueError(f"its member {name} has more than its header says")
    except _UNSOUND as error:
        raise ValueError(f"it is not a valid NPZ file ({error})") from error
    return arrays


def to_npy(array: NDArray[Any]) -> bytes:
    """The bytes of a ``.npy`` file."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def to_npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """The bytes of an ``.npz`` file; they depend only on the arrays."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), to_npy(arrays[name]))  # dated 1980
    return buffer.getvalue()
