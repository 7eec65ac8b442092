"""What ``features.json`` of TensorFlow Datasets says of the lists in a record."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError
from acwm_core.files import check_fetched, parse_json
from acwm_formats.frames import MOST_FRAMES
from acwm_formats.images import MOST_BYTES

FEATURES = "features.json"

NUMBERS = (
    *("bool", "uint8", "uint16", "uint32", "uint64", "int8", "int16", "int32", "int64"),
    *("float16", "float32", "float64"),
)

Kind = Literal["image", "text", "numbers", "other"]

Lists = Mapping[str, list[bytes] | NDArray[Any]]


@dataclass(frozen=True)
class Feature:
    """One feature, as it is flattened in a record.

    Attributes:
        path: its name in the record, e.g. ``steps/observation/image``.
        kind: what it holds; `other` is not read.
        shape: of one value.
        dtype: of numbers, and of an image's pixels.
        encoding: of numbers: ``none``, or ``bytes`` or ``zlib`` for bytes of a value each.
    """

    path: str
    kind: Kind
    shape: tuple[int, ...] = ()
    dtype: str = ""
    encoding: str = "none"

    def values(self, lists: Lists, count: int) -> NDArray[Any]:
        """The numbers of `count` steps, ``[count, …]``.

        Raises:
            DataError: they are missing, or too few or too many.
        """
        items = lists.get(self.path)
        if self.encoding != "none" and isinstance(items, list):
            values = [self._unpacked(item) for item in items]
            rows = np.stack(values) if values else np.zeros((0, *self.shape), self.dtype)
        elif isinstance(items, np.ndarray):
            rows = items
        else:
            raise DataError(f"{self.path} has no numbers")
        if rows.size != count * math.prod(self.shape):
            raise DataError(
                f"{self.path} has {rows.size} numbers for {count} steps of {[*self.shape]}"
            )
        return rows.reshape(count, *self.shape).astype(self.dtype, copy=False)

    def texts(self, lists: Lists) -> list[str]:
        """Its texts, one for each step or a single one.

        Raises:
            DataError: they are missing or not in UTF-8.
        """
        items = lists.get(self.path)
        if not isinstance(items, list):
            raise DataError(f"{self.path} has no texts")
        try:
            return [text.decode() for text in items]
        except UnicodeDecodeError as error:
            raise DataError(f"{self.path} is no text in UTF-8") from error

    def _unpacked(self, data: bytes) -> NDArray[Any]:
        wanted = math.prod(self.shape) * np.dtype(self.dtype).itemsize
        if self.encoding == "zlib":
            try:
                data = zlib.decompressobj().decompress(data, wanted + 1)
            except zlib.error as error:
                raise DataError(f"{self.path} is damaged ({error})") from error
        if len(data) != wanted:
            raise DataError(f"{self.path} has a value of other than {wanted} bytes")
        return np.frombuffer(data, np.dtype(self.dtype).newbyteorder("<")).reshape(self.shape)


def read_features(root: Path) -> dict[str, Feature]:
    """The features of a dataset by path.

    Raises:
        DataError: there are none, or they are not those of episodes.
    """
    path = root / FEATURES
    check_fetched(path)
    try:
        content = parse_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(f"{path} cannot be read ({error})") from error
    if isinstance(content, dict) and "content" in content and "featuresDict" not in content:
        raise DataError(f"{path} is of TensorFlow Datasets before 4.6: let a newer one write it")
    features = {leaf.path: leaf for leaf in _leaves(content, "")}
    if not any(name.startswith("steps/") for name in features):
        raise DataError(f"{path} describes no episodes, which RLDS keeps in `steps`")
    return features


def _leaves(feature: Any, path: str) -> Iterator[Feature]:
    if not isinstance(feature, dict):
        yield Feature(path, "other")
    elif isinstance(inner := feature.get("featuresDict"), dict):
        for name, part in dict(inner.get("features") or {}).items():
            yield from _leaves(part, f"{path}/{name}" if path else str(name))
    elif path == "steps" and isinstance(inner := feature.get("sequence"), dict):
        yield from _leaves(inner.get("feature"), path)
    else:
        yield _leaf(feature, path)


def _leaf(feature: Mapping[str, Any], path: str) -> Feature:
    if "text" in feature:
        return Feature(path, "text")
    image, tensor = feature.get("image"), feature.get("tensor")
    facts = image if isinstance(image, dict) else tensor if isinstance(tensor, dict) else {}
    dtype, encoding = str(facts.get("dtype", "")), str(facts.get("encoding", "none"))
    if dtype in ("string", "object"):
        return Feature(path, "text")
    if "classLabel" in feature:
        return Feature(path, "numbers", dtype="int64")
    shape = _shape(facts.get("shape"))
    if shape is None or dtype not in NUMBERS or encoding not in ("none", "bytes", "zlib"):
        return Feature(path, "other")
    if math.prod(shape) * np.dtype(dtype).itemsize > MOST_BYTES:
        raise DataError(f"{path} claims values of {[*shape]}, more than are read")
    return Feature(path, "image" if facts is image else "numbers", shape, dtype, encoding)


def _shape(claimed: Any) -> tuple[int, ...] | None:
    """The shape of a value; None if it changes from step to step."""
    sides = claimed.get("dimensions", []) if isinstance(claimed, dict) else []
    whole = [int(side) for side in sides if str(side).isdecimal() and len(str(side)) < 10]
    if len(whole) != len(sides) or max(whole, default=0) > MOST_FRAMES:
        return None
    return tuple(whole)
