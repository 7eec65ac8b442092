"""Arrays and JSON to the bytes of a shard's members, and back from bytes that may lie.

Readers hold no more memory than a few times the bytes they are given, run nothing that is pickled,
and raise `ValueError` (or another of `UNREADABLE`) for whatever the writers below do not write.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time a zip archive can hold
NUMBERS = "biuf"
"""Kinds of arrays: truth values, integers and floats."""

MOST_JSON = 2**20
"""Bytes of a JSON member; ours have under a thousand."""

UNREADABLE = (
    ValueError,
    KeyError,
    TypeError,
    EOFError,
    OverflowError,
    RecursionError,
    NotImplementedError,
    zipfile.BadZipFile,
)
"""What the readers of this module raise."""


def to_npy(array: NDArray[Any]) -> bytes:
    """The bytes of a ``.npy`` file."""
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()


def from_npy(data: bytes) -> NDArray[Any]:
    """The numbers in a ``.npy`` file of version 1, whose claimed shape its bytes must bear out."""
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):
        raise ValueError(f"it is a .npy file of version {version}")
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject:
        raise ValueError("it holds pickled objects, which are never loaded")
    if dtype.kind not in NUMBERS:
        raise ValueError(f"it holds {dtype}, not numbers")
    held, claimed = len(data) - stream.tell(), math.prod(shape) * dtype.itemsize
    if held != claimed or min(shape, default=0) < 0:
        raise ValueError(f"it claims {dtype} {shape}, {claimed} bytes, and holds {held}")
    flat = np.frombuffer(data, dtype, offset=stream.tell())
    return flat.reshape(shape, order="F" if fortran else "C").copy()


def to_npz(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """An ``.npz`` whose bytes depend on the arrays alone."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(arrays):
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", EPOCH), to_npy(arrays[name]))
    return buffer.getvalue()


def from_npz(data: bytes) -> dict[str, NDArray[Any]]:
    """The arrays of an ``.npz`` that is not compressed, so that it holds what it claims."""
    arrays: dict[str, NDArray[Any]] = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        infos = archive.infolist()
        if sum(info.file_size for info in infos) > len(data):
            raise ValueError(f"it claims more than its {len(data)} bytes can hold")
        for info in infos:
            name = info.filename.removesuffix(".npy")
            if info.compress_type != zipfile.ZIP_STORED or name in arrays:
                raise ValueError(f"{info.filename!r} is compressed, or there twice")
            arrays[name] = from_npy(archive.read(info))
    return arrays


def from_json(data: bytes) -> dict[str, Any]:
    """A JSON object."""
    if len(data) > MOST_JSON:
        raise ValueError(f"it has {len(data)} bytes")
    values = json.loads(data)
    if not isinstance(values, dict):
        raise ValueError("it is no JSON object")
    return cast(dict[str, Any], values)
