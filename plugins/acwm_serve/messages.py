"""Messages: maps in msgpack, in which arrays are written as openpi's clients write them."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np

from acwm_core.errors import DataError

PLAIN = re.compile(r"[<|=]?(u1|[if][248])")
"""The types of numbers that are read, as NumPy writes them."""


def packed(values: Mapping[str, Any]) -> bytes:
    """A message of plain values and NumPy arrays."""
    return bytes(msgpack.packb(values, default=_as_map) or b"")


def unpacked(data: bytes) -> dict[str, Any]:
    """The map that a client sent, with its arrays.

    Raises:
        DataError: it is no map in msgpack, or an array in it does not fit its shape.
    """
    try:
        message = msgpack.unpackb(data, object_hook=_array)
    except (ValueError, TypeError, msgpack.UnpackException, RecursionError) as error:
        raise DataError(f"a message is a map in msgpack, not {len(data)} other bytes") from error
    if not isinstance(message, dict):
        raise DataError(f"a message is a map in msgpack, not a {type(message).__name__}")
    return message


def _as_map(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        raise TypeError(f"{type(value).__name__} cannot be sent")
    kind, contents = value.dtype.str, np.ascontiguousarray(value).tobytes()
    return {"__ndarray__": True, "data": contents, "dtype": kind, "shape": value.shape}


def _array(values: dict[Any, Any]) -> Any:
    """The array that a map holds, or the map."""
    named = {
        k.decode(errors="replace") if isinstance(k, bytes) else k: v for k, v in values.items()
    }
    if "__ndarray__" not in named:
        return named
    data, kind, shape = (named.get(name) for name in ("data", "dtype", "shape"))
    kind = _text(kind)
    plain = isinstance(kind, str) and PLAIN.fullmatch(kind)
    sizes = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    if not (plain and sizes and isinstance(data, bytes)):
        raise DataError(
            "an array is bytes `data` of a `dtype` u1, f2 to f8, i2 to i8, and a `shape`"
        )
    type_, shape = np.dtype(kind), list[int](shape or [])
    if len(data) != math.prod(shape) * type_.itemsize:
        raise DataError(f"an array {shape} of {kind} does not have {len(data)} bytes")
    return np.frombuffer(data, type_).reshape(shape).copy()


def _text(value: Any) -> Any:
    """Names as text, which openpi's clients send as bytes."""
    return value.decode(errors="replace") if isinstance(value, bytes) else value
