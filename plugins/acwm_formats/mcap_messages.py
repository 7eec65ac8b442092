"""Messages in MCAP files: topics, times and numbers in one scan, and messages one by one."""

from __future__ import annotations

import contextlib
import functools
import re
import struct
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.decoder import DecoderFactory
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.stream_reader import MAGIC_SIZE
from mcap_protobuf.decoder import DecoderFactory as Protobuf
from mcap_ros2.decoder import DecoderFactory as Ros2
from numpy.typing import NDArray

from acwm_core.arrays import check_unpacked
from acwm_core.errors import DataError
from acwm_core.files import check_fetched, parse_json
from acwm_formats.frames import file_stamp
from acwm_formats.packed import check_packed
from acwm_formats.texts import Fact, text_facts

MAGIC = b"\x89MCAP0\r\n"
"""The first and the last bytes of a file."""

_RECORD = struct.Struct("<BQ")
"""The kind of a record, and its length."""

_CHUNK = struct.Struct("<QQQII")
"""How a chunk begins: its times, the bytes that it unpacks to, a checksum, and the length of the
compression's name, which follows."""

UNNUMBERED = ("header", "stamp", "timestamp", "layout", "name", "frame_id")
"""Fields of messages that hold no action."""


NUMBERS = (bool, int, float, np.number)


class Numbers(NamedTuple):
    """The numbers in the messages of a topic, or in one field of them.

    Attributes:
        names: one per column.
        times: ``[N]`` when each message was logged, in ns.
        stamps: ``[N]`` the times in the messages' headers, in ns; 0 if there are none.
        rows: ``[N, len(names)]``.
    """

    names: tuple[str, ...]
    times: NDArray[np.int64]
    stamps: NDArray[np.int64]
    rows: NDArray[np.float64]


class LoggedMessage(NamedTuple):
    """A message of one of the topics that were asked for.

    Attributes:
        topic: where it was logged.
        kind: the name of its schema.
        time: when it was logged, in ns.
        content: decodes it; raises a `DataError` if it cannot.
    """

    topic: str
    kind: str
    time: int
    content: Callable[[], Any]


class _Json(DecoderFactory):
    """Decodes messages in JSON."""

    def decoder_for(self, message_encoding: str, schema: Any) -> Any:
        return parse_json if message_encoding == "json" else None


def topics(path: Path) -> dict[str, str]:
    """The kind of message of each topic.

    Raises:
        DataError: the file is damaged.
    """
    with _opened(path) as reader:
        summary = reader.get_summary()
        if summary is None or not summary.channels:
            messages = reader.iter_messages()
            return {channel.topic: schema.name if schema else "" for schema, channel, _ in messages}
        schemas = summary.schemas
        return {
            channel.topic: schemas[channel.schema_id].name if channel.schema_id else ""
            for channel in summary.channels.values()
        }


def entries(path: Path, wanted: Sequence[str]) -> Iterator[LoggedMessage]:
    """The messages of some topics, in the order in which they were logged.

    Raises:
        DataError: the file is damaged.
    """
    factories = (_Json(), Ros2(), Protobuf())
    decoders: dict[int, Any] = {}
    with _opened(path) as reader:
        for schema, channel, message in reader.iter_messages(topics=list(wanted)):
            if channel.id not in decoders:
                encoding = channel.message_encoding
                fitting = (factory.decoder_for(encoding, schema) for factory in factories)
                decoders[channel.id] = next(filter(None, fitting), None)
            decode = _decoding(path, channel, decoders[channel.id], message.data)
            yield LoggedMessage(
                channel.topic, schema.name if schema else "", message.log_time, decode
            )


def _decoding(path: Path, channel: Any, decoder: Any, data: bytes) -> Callable[[], Any]:
    def content() -> Any:
        what = f"a message of {channel.topic} in {path}"
        if decoder is None:
            raise DataError(f"{what} is in {channel.message_encoding}, which cannot be decoded")
        try:
            return decoder(data)
        except Exception as error:  # every encoding has its own exceptions
            raise DataError(f"{what} is damaged ({type(error).__name__}: {error})") from error

    return content


def check_chunks(path: Path) -> None:
    """Refuse a log that is cut off, or of which a chunk unpacks to far more than it stores.

    Raises:
        ValueError: it is.
    """
    size, place = path.stat().st_size, MAGIC_SIZE
    with path.open("rb") as file:
        file.seek(max(0, size - MAGIC_SIZE))
        if size < 2 * MAGIC_SIZE or not file.read().startswith(MAGIC):
            raise ValueError("it is cut off: repair it with `mcap recover`")
        file.seek(place)
        while place < size and len(head := file.read(_RECORD.size)) == _RECORD.size:
            kind, length = _RECORD.unpack(head)
            if kind == Opcode.CHUNK:
                start = file.read(length)
                *_, unpacked, _, named = _CHUNK.unpack_from(start)
                data = start[_CHUNK.size + named + 8 :]
                check_unpacked(length, unpacked)
                check_packed(data)
            place += _RECORD.size + length
            file.seek(place)


@functools.lru_cache(maxsize=256)
def _checked(path: Path, _: str) -> None:
    check_chunks(path)


@contextlib.contextmanager
def _opened(path: Path) -> Generator[Any]:
    """A reader of the file; what it finds wrong in the block becomes a `DataError`."""
    check_fetched(path)
    try:
        _checked(path, file_stamp(path))
        with path.open("rb") as file:
            yield make_reader(file)
    except DataError:
        raise
    except Exception as error:  # every compression has its own exceptions
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DataError(f"the log {path} cannot be read ({reason})") from error


@dataclass
class NumberMessages:
    """Gathers the numbers of a topic, or of one field of it: ``TOPIC`` or ``TOPIC:FIELD``."""

    name: str
    names: tuple[str, ...] = ()
    times: list[int] = field(default_factory=list[int])
    stamps: list[int] = field(default_factory=list[int])
    rows: list[list[float]] = field(default_factory=list[list[float]])
    problem: DataError | None = None

    @property
    def topic(self) -> str:
        """Where its messages were logged."""
        return self.name.partition(":")[0]

    def add(self, entry: LoggedMessage) -> None:
        """Add the numbers of a message; `numbers` reports what is wrong with it."""
        if self.problem is None:
            try:
                self._add(entry)
            except DataError as error:
                self.problem = error

    def _add(self, entry: LoggedMessage) -> None:
        content, asked = entry.content(), self.name.partition(":")[2]
        leaves = {name: float(number) for name, number in _leaves(content)}
        if asked:
            leaves = {n: v for n, v in leaves.items() if re.split(r"[.\[]", n)[0] == asked}
        if not leaves:
            raise DataError(f"message {len(self.rows)} of {self.name} holds no numbers")
        self.names = self.names or tuple(leaves)
        if tuple(leaves) != self.names:
            raise DataError(
                f"message {len(self.rows)} of {self.name} holds {len(leaves)} numbers, but "
                f"the first {len(self.names)}"
            )
        self.times.append(entry.time)
        self.stamps.append(stamp_of(content))
        self.rows.append(list(leaves.values()))

    def numbers(self) -> Numbers:
        """What was gathered.

        Raises:
            DataError: there are no messages, or not all hold the same numbers.
        """
        if self.problem is not None:
            raise self.problem
        if not self.rows:
            raise DataError(f"there is no message of {self.name}")
        times, stamps = np.array(self.times, np.int64), np.array(self.stamps, np.int64)
        return Numbers(self.names, times, stamps, np.array(self.rows))


@dataclass
class TextMessages:
    """Gathers the texts of a topic, by field; it says nothing if messages hold numbers, too."""

    topic: str
    texts: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    numeric: bool = False

    def add(self, entry: LoggedMessage) -> None:
        """Add the texts of a message."""
        if self.numeric:
            return
        with contextlib.suppress(DataError):  # nobody asked for it
            content = entry.content()
            self.numeric = next(_leaves(content), None) is not None
            for name, text in () if self.numeric else _leaves(content, kinds=(str,)):
                self.texts.setdefault(name, []).append(text)

    def facts(self) -> dict[str, Fact]:
        """What it says, by the name of the topic, and of the field if there are several."""
        title = self.topic.strip("/").replace("/", ".")
        one = len(self.texts) == 1
        named = {title if one else f"{title}.{name}": t for name, t in self.texts.items()}
        return {} if self.numeric else text_facts(named)


def descriptions(path: Path) -> dict[str, Fact]:
    """The texts in a file's records of metadata.

    Raises:
        DataError: the file is damaged.
    """
    with _opened(path) as reader:
        records = [(record.name, record.metadata) for record in reader.iter_metadata()]
    known = {f"{name}.{key}": [text] for name, texts in records for key, text in texts.items()}
    return text_facts(known)


def stamp_of(message: Any) -> int:
    """The time in the header of a message, or in its field `timestamp`, in ns; 0 if it has none."""
    header = content_of(message, "header") if _fields(message) is not None else None
    for place in (header, message):
        for name in ("stamp", "timestamp"):
            time = content_of(place, name) if place is not None else None
            if (stamp := _nanoseconds(time)) is not None:
                return stamp
    return 0


def _nanoseconds(time: Any) -> int | None:
    """A time as ROS, Foxglove or Protobuf have it: seconds and nanoseconds."""
    if time is None or isinstance(time, int | float | str | bytes | list):
        return None
    parts = [
        next((p for n in names if isinstance(p := content_of(time, n), int)), None)
        for names in (("sec", "secs", "seconds"), ("nanosec", "nsec", "nsecs", "nanos"))
    ]
    return None if parts[0] is None else parts[0] * 10**9 + (parts[1] or 0)


def _leaves(value: Any, name: str = "", kinds: tuple[type, ...] = NUMBERS) -> Iterator[Any]:
    """The numbers in a message, or what else it holds of some kinds, by their path in it."""
    if isinstance(value, kinds):
        yield name, value
    elif isinstance(value, (str, bytes, *NUMBERS)) or value is None:
        return
    elif (fields := _fields(value)) is not None:
        for key in fields:
            if key not in UNNUMBERED:
                yield from _leaves(content_of(value, key), f"{name}.{key}".lstrip("."), kinds)
    else:
        for place, entry in enumerate(value):
            yield from _leaves(entry, f"{name}[{place}]", kinds)


def _fields(message: Any) -> list[str] | None:
    """The names of the fields of a message in any encoding; None for a list."""
    if isinstance(message, dict):
        return list(message)
    if hasattr(message, "DESCRIPTOR"):
        return [field.name for field in message.DESCRIPTOR.fields]
    slots = getattr(message, "__slots__", None)
    return [slot for slot in slots if not slot.startswith("_")] if slots else None


def content_of(message: Any, name: str) -> Any:
    """A field of a message in any encoding; None if it has none of that name."""
    return message.get(name) if isinstance(message, dict) else getattr(message, name, None)
