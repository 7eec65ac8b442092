"""Writes a tiny RLDS dataset, for the conformance suite and for tests."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_formats.rlds_features import FEATURES
from acwm_formats.tfrecords import EXAMPLE, HEAD, SUM, masked_crc

SIDE, LENGTHS = 32, (5, 6)
FRAME = (SIDE, SIDE, 3)


def framed(data: bytes) -> bytes:
    """A record of a TFRecord file."""
    length = len(data).to_bytes(8, "little")
    head = HEAD.pack(len(data), masked_crc(length))
    return head + data + SUM.pack(masked_crc(data))


def example_of(lists: Mapping[str, Sequence[bytes] | NDArray[Any]]) -> bytes:
    """A ``tf.train.Example`` of lists by name."""
    message = EXAMPLE()
    for name, values in lists.items():
        feature = message.features.feature[name]
        if not isinstance(values, np.ndarray):
            feature.bytes_list.value.extend(values)
        elif values.dtype.kind == "f":
            feature.float_list.value.extend(values.ravel().tolist())
        else:
            feature.int64_list.value.extend(map(int, values.ravel()))
    return message.SerializeToString()


def tensor(shape: Sequence[int], dtype: str, encoding: str = "none") -> dict[str, Any]:
    """What ``features.json`` says of numbers."""
    sides = {"dimensions": [str(side) for side in shape]} if shape else {}
    return {"tensor": {"shape": sides, "dtype": dtype, "encoding": encoding}}


def features_of(step: Mapping[str, Any]) -> dict[str, Any]:
    """The content of ``features.json`` of such steps; a map is a nested one."""

    def nested(values: Mapping[str, Any]) -> dict[str, Any]:
        leaves = {"tensor", "text"}
        inside = {n: v if {*v} & leaves else nested(v) for n, v in values.items()}
        return {"featuresDict": {"features": inside}}

    steps = {"sequence": {"feature": nested(step), "length": "-1"}}
    return {"featuresDict": {"features": {"steps": steps}}}


def write_dataset(
    folder: Path, step: Mapping[str, Any], records: Iterable[bytes], name: str = "noise"
) -> Path:
    """Write the files of one split in one shard; returns the shard."""
    folder.mkdir(parents=True)
    (folder / FEATURES).write_text(json.dumps(features_of(step)), encoding="utf-8")
    shard = folder / f"{name}-train.tfrecord-00000-of-00001"
    shard.write_bytes(b"".join(map(framed, records)))
    return shard


def write_example(folder: Path) -> Path:
    """Write two short episodes of noise; returns the shard."""
    rng, records = np.random.default_rng(0), list[bytes]()
    for length in LENGTHS:
        frames = rng.integers(0, 256, (length, *FRAME), np.uint8)
        lists: dict[str, Any] = {
            "steps/observation/image": [frame.tobytes() for frame in frames],
            "steps/action": rng.uniform(-1, 1, (length, 2)),
            "steps/is_first": np.arange(length) == 0,
            "steps/is_last": np.arange(length) == length - 1,
        }
        records.append(example_of(lists))
    flag = tensor((), "bool")
    step = {
        "observation": {"image": tensor(FRAME, "uint8", "bytes")},
        "action": tensor((2,), "float32"),
        "is_first": flag,
        "is_last": flag,
    }
    return write_dataset(folder, step, records)
