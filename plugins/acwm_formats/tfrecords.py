"""TFRecord files and the messages in them, without TensorFlow.

A record is its length (8 bytes, little-endian), a checksum of the length (4 bytes), the data, and a
checksum of the data. Checksums are CRC-32C, turned and shifted by a constant, so that data that
contain checksums keep good ones. The data are a ``tf.train.Example``: lists of bytes, of floats or
of whole numbers by name. The readers of the package registry that need no TensorFlow check no sums
and trust the claimed length.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import google_crc32c
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from acwm_core.errors import DataError
from acwm_core.files import check_fetched

HEAD, SUM = struct.Struct("<QI"), struct.Struct("<I")
"""Before the data: their length and its checksum; after them: their checksum."""


class RecordPlace(NamedTuple):
    """Where the data of a record lie in its file, in bytes."""

    start: int
    length: int


def masked_crc(data: bytes) -> int:
    """The checksum that TFRecord files have."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def record_places(path: Path) -> list[RecordPlace]:
    """Where the records of a file lie; their data are not read.

    Raises:
        DataError: the file is missing, cut off or damaged, or no file of records.
    """
    check_fetched(path)
    places: list[RecordPlace] = []
    try:
        size, start = path.stat().st_size, 0
        with path.open("rb") as file:
            while start < size:
                file.seek(start)
                head = file.read(HEAD.size)
                length, claimed = HEAD.unpack(head.ljust(HEAD.size, b"\0"))
                whole = len(head) == HEAD.size
                if whole and masked_crc(head[:8]) != claimed:
                    raise DataError(
                        f"{path} is damaged, or no TFRecord file: the length of record "
                        f"{len(places)} (counted from 0) has another checksum"
                    )
                end = start + HEAD.size + length + SUM.size
                if not whole or end > size:
                    raise DataError(f"{path} is cut off in record {len(places)} (counted from 0)")
                places.append(RecordPlace(start + HEAD.size, length))
                start = end
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror})") from error
    return places


def read_record(path: Path, place: RecordPlace) -> bytes:
    """The data of a record.

    Raises:
        DataError: the file cannot be read, or the data have another checksum.
    """
    try:
        with path.open("rb") as file:
            file.seek(place.start)
            data, claimed = file.read(place.length), file.read(SUM.size)
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror})") from error
    if len(claimed) != SUM.size or masked_crc(data) != SUM.unpack(claimed)[0]:
        raise DataError(f"{path} is damaged: the record at byte {place.start} has another checksum")
    return data


def parse_example(data: bytes) -> dict[str, list[bytes] | NDArray[Any]]:
    """The lists of a ``tf.train.Example`` by name: bytes, or an array ``[N]`` of numbers.

    Raises:
        DataError: it is no such message.
    """
    try:
        features: Mapping[str, Any] = EXAMPLE.FromString(data).features.feature
    except DecodeError as error:
        raise DataError(f"a record is no tf.train.Example ({error})") from error
    lists: dict[str, list[bytes] | NDArray[Any]] = {}
    for name, feature in features.items():
        kind = feature.WhichOneof("kind")
        if kind == "bytes_list":
            lists[name] = [*feature.bytes_list.value]
        elif kind == "float_list":
            lists[name] = np.array(feature.float_list.value, np.float32)
        elif kind == "int64_list":
            lists[name] = np.array(feature.int64_list.value, np.int64)
    return lists


def _example() -> Any:
    """The class of ``tf.train.Example``, from the numbers and types of its fields."""
    of, package = descriptor_pb2.FieldDescriptorProto, ".acwm.tf."
    file = descriptor_pb2.FileDescriptorProto(name="acwm_tf", package="acwm.tf", syntax="proto3")

    def add(message: Any, name: str, type_: int | str, *, many: bool = False) -> Any:
        label = of.LABEL_REPEATED if many else of.LABEL_OPTIONAL
        field = message.field.add(name=name, number=len(message.field) + 1, label=label)
        if isinstance(type_, str):
            field.type, field.type_name = of.TYPE_MESSAGE, package + type_
        else:
            field.type = type_
        return field

    for name, kind in (
        ("BytesList", of.TYPE_BYTES),
        ("FloatList", of.TYPE_FLOAT),
        ("Int64List", of.TYPE_INT64),
    ):
        add(file.message_type.add(name=name), "value", kind, many=True)
    feature = file.message_type.add(name="Feature")
    feature.oneof_decl.add(name="kind")
    for name in ("bytes", "float", "int64"):
        add(feature, f"{name}_list", f"{name.title()}List").oneof_index = 0
    features = file.message_type.add(name="Features")
    entry = features.nested_type.add(name="FeatureEntry")
    entry.options.map_entry = True
    add(entry, "key", of.TYPE_STRING)
    add(entry, "value", "Feature")
    add(features, "feature", "Features.FeatureEntry", many=True)
    add(file.message_type.add(name="Example"), "features", "Features")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("acwm.tf.Example"))


EXAMPLE = _example()
"""The class of ``tf.train.Example``."""
