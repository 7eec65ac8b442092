"""The format MCAP: logs of robots, with compressed images and a topic of numbers."""

from __future__ import annotations

import base64
import contextlib
import io
import json
import re
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.decoder import DecoderFactory
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory as Protobuf
from mcap_ros2.decoder import DecoderFactory as Ros2
from numpy.typing import NDArray
from PIL import Image

from acwm_core.errors import DataError, suggest
from acwm_core.files import parse_json
from acwm_formats.format import Format
from acwm_formats.frames import ImageFrames, file_stamp
from acwm_formats.names import natural, word, words
from acwm_formats.timeline import ActionFacts, RecordedDataset, Samples, TimedRecording

MAGIC = b"\x89MCAP0\r\n"
UNNUMBERED = ("header", "stamp", "timestamp", "layout", "name", "frame_id")
"""Fields of messages that hold no action."""


class Log(NamedTuple):
    """What one file is read by.

    Attributes:
        cameras: the topics of images.
        actions: the topic of actions, perhaps followed by a colon and a field.
        states: topics of states, in the same way.
    """

    cameras: tuple[str, ...]
    actions: str
    states: tuple[str, ...]


class MCAP(Format):
    """MCAP files with messages in JSON, ROS 2 or Protobuf; only read."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether it is or holds MCAP files."""
        return bool(_files(path))

    def read(
        self,
        root: Path,
        *,
        video: str | None = None,
        actions: str | None = None,
        states: str | None = None,
    ) -> RecordedDataset:
        """Import an MCAP file, or a folder of them, one episode each.

        Messages of images (CompressedImage of ROS 2 or Foxglove) and of numbers are brought
        together by the times at which they were logged.

        Args:
            root: the file or folder.
            video: Topics of images, with a comma between; all by default.
            actions: Topic of the actions, or TOPIC:FIELD; by default the only one with numbers.
            states: Topics of the states, or TOPIC:FIELD, with a comma between; none by default.
        """
        root = Path(root)
        files = _files(root)
        if not files:
            raise DataError(f"{root} is no MCAP file and holds none")
        kinds = _topics(files[0])
        images = [topic for topic, kind in kinds.items() if _is_image(kind)]
        log = Log(
            _known(files[0], words(video), kinds) or tuple(images),
            _actions(files[0], actions, kinds, images),
            words(states),
        )
        _known(files[0], [each.partition(":")[0] for each in (log.actions, *log.states)], kinds)
        if not log.cameras:
            raise DataError(f"{files[0]} has no topic of compressed images, only {_told(kinds)}")
        names, _, _ = _numbers(files[0], log.actions)
        return RecordedDataset(
            name=word(root),
            splits=Logs(tuple(files), log),
            facts={"kind": "mcap", "name": root.resolve().name, "files": len(files)}
            | {"bytes": sum(path.stat().st_size for path in files)},
            options={"video": video, "actions": actions, "states": states},
            actions=ActionFacts(names),
            notes=(f"Actions are {log.actions}; its times are those of the log.",),
            summary=f"Logs of {root.resolve().name}",
        )

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """Three short logs in JSON."""
        rng = np.random.default_rng(0)
        for episode in range(3):
            write_example(folder / f"run_{episode}.mcap", rng, 6 + episode)
        return {"root": folder}


@dataclass(frozen=True)
class Logs:
    """One recording per file, opened on request."""

    files: tuple[Path, ...]
    log: Log

    def __len__(self) -> int:
        """The number of files."""
        return len(self.files)

    def __getitem__(self, index: int) -> TimedRecording:
        """Open one file; times count from its first message of an image."""
        path = self.files[index]
        stamps = {topic: _times(path, topic) for topic in self.log.cameras}
        zero = min((int(each[0]) for each in stamps.values() if len(each)), default=0)
        cameras = {
            topic.strip("/").replace("/", "."): ImageFrames(
                LoggedImages(path, topic, len(each)),
                (each - zero) / 1e9,
                stamp=f"{topic} {file_stamp(path)}",
            )
            for topic, each in stamps.items()
        }
        states = {
            topic.strip("/").replace("/", "."): _samples(path, topic, zero)
            for topic in self.log.states
        }
        return TimedRecording(path.name, cameras, _samples(path, self.log.actions, zero), states)


class LoggedImages(Sequence[Any]):
    """The pictures of a topic, best read in order."""

    def __init__(self, path: Path, topic: str, count: int) -> None:
        self._path, self._topic, self._count = path, topic, count
        self._messages: Iterator[bytes] | None = None
        self._next, self._image = 0, b""

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_messages": None, "_next": 0, "_image": b""}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> bytes:
        if self._messages is None or index < self._next - 1:
            self._messages, self._next = _pictures(self._path, self._topic), 0
        while self._next <= index:
            self._image = next(self._messages)
            self._next += 1
        return self._image


def _files(path: Path) -> list[Path]:
    if path.is_file():
        with path.open("rb") as file:
            return [path] if file.read(len(MAGIC)) == MAGIC else []
    return sorted(path.glob("*.mcap"), key=lambda each: natural(each.name))


class _Json(DecoderFactory):
    """Decodes messages in JSON."""

    def decoder_for(self, message_encoding: str, schema: Any) -> Any:
        return parse_json if message_encoding == "json" else None


@contextlib.contextmanager
def _opened(path: Path) -> Generator[Any]:
    """A reader of the file; what it finds wrong in the block becomes a `DataError`."""
    try:
        with path.open("rb") as file:
            yield make_reader(file, decoder_factories=[_Json(), Ros2(), Protobuf()])
    except DataError:
        raise
    except (McapError, OSError, ValueError, KeyError, EOFError, StopIteration) as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise DataError(f"the log {path} cannot be read ({reason})") from error


def _topics(path: Path) -> dict[str, str]:
    """The kind of message of each topic."""
    with _opened(path) as reader:
        summary = reader.get_summary()
        if summary is None or not summary.channels:
            return {
                channel.topic: schema.name if schema else ""
                for schema, channel, _ in reader.iter_messages()
            }
        schemas = summary.schemas
        return {
            channel.topic: schemas[channel.schema_id].name if channel.schema_id else ""
            for channel in summary.channels.values()
        }


def _times(path: Path, topic: str) -> NDArray[np.int64]:
    with _opened(path) as reader:
        found = [message.log_time for _, _, message in reader.iter_messages(topics=[topic])]
    return np.array(found, np.int64)


def _pictures(path: Path, topic: str) -> Iterator[bytes]:
    with _opened(path) as reader:
        for decoded in reader.iter_decoded_messages(topics=[topic]):
            data = _field(decoded.decoded_message, "data")
            if not _is_image(decoded.schema.name if decoded.schema else "") or data is None:
                raise DataError(f"{topic} of {path} holds no compressed images")
            yield base64.b64decode(data) if isinstance(data, str) else bytes(data)


def _is_image(kind: str) -> bool:
    return re.split(r"[./]", kind)[-1] == "CompressedImage"


def _samples(path: Path, topic: str, zero: int) -> Samples:
    _, times, rows = _numbers(path, topic)
    return Samples(rows, (times - zero) / 1e9)


def _numbers(path: Path, topic: str) -> tuple[tuple[str, ...], NDArray[np.int64], NDArray[Any]]:
    """Names, times and values of a topic's numbers, or those of one field of it."""
    where, _, field = topic.partition(":")
    names: tuple[str, ...] = ()
    times: list[int] = []
    rows: list[list[float]] = []
    with _opened(path) as reader:
        for decoded in reader.iter_decoded_messages(topics=[where]):
            found = dict(_leaves(decoded.decoded_message))
            if field:
                found = {n: v for n, v in found.items() if re.split(r"[.\[]", n)[0] == field}
            names = names or tuple(found)
            if tuple(found) != names or not names:
                raise DataError(
                    f"message {len(rows)} of {topic} in {path} holds {len(found)} numbers, the "
                    f"first {len(names)}"
                )
            times.append(decoded.message.log_time)
            rows.append([float(value) for value in found.values()])
    if not rows:
        raise DataError(f"{path} has no message of {topic}")
    return names, np.array(times, np.int64), np.array(rows)


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, float]]:
    """The numbers in a message, by their path in it."""
    if isinstance(value, bool | int | float | np.number):
        yield name, float(value)
    elif isinstance(value, str | bytes) or value is None:
        return
    elif (fields := _fields(value)) is not None:
        for field in fields:
            if field not in UNNUMBERED:
                yield from _leaves(_field(value, field), f"{name}.{field}".lstrip("."))
    else:
        for place, entry in enumerate(value):
            yield from _leaves(entry, f"{name}[{place}]")


def _fields(message: Any) -> list[str] | None:
    """The names of the fields of a message in any encoding; None for a list."""
    if isinstance(message, dict):
        return list(message)
    if hasattr(message, "DESCRIPTOR"):
        return [field.name for field in message.DESCRIPTOR.fields]
    slots = getattr(message, "__slots__", None)
    return [slot for slot in slots if not slot.startswith("_")] if slots else None


def _field(message: Any, name: str) -> Any:
    return message.get(name) if isinstance(message, dict) else getattr(message, name, None)


def _known(path: Path, topics: Sequence[str], kinds: dict[str, str]) -> tuple[str, ...]:
    for topic in topics:
        if topic not in kinds:
            raise DataError(f"{path} has no topic {topic!r}{suggest(topic, kinds)}")
    return tuple(topics)


def _actions(path: Path, wanted: str | None, kinds: dict[str, str], images: list[str]) -> str:
    """The topic of actions: the one that is wanted, or the only one with numbers."""
    if wanted:
        return wanted
    found: list[str] = []
    for topic in kinds:
        with contextlib.suppress(DataError):
            if topic not in images and _numbers(path, topic):
                found.append(topic)
    if len(found) != 1:
        raise DataError(
            f"{path} has {len(found)} topics of numbers ({', '.join(found)}): give --actions TOPIC"
        )
    return found[0]


def _told(kinds: dict[str, str]) -> str:
    return ", ".join(f"{topic} ({kind})" for topic, kind in kinds.items())


def write_example(path: Path, rng: np.random.Generator, length: int) -> None:
    """A log of pictures of noise and of two numbers, 10 per second."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        image = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        numbers = writer.register_schema("Command", "jsonschema", b"{}")
        camera = writer.register_channel("/camera", "json", image)
        command = writer.register_channel("/command", "json", numbers)
        for place in range(length):
            png = io.BytesIO()
            Image.fromarray(rng.integers(0, 256, (32, 32, 3), np.uint8)).save(png, "PNG")
            text = base64.b64encode(png.getvalue()).decode()
            messages: dict[int, Any] = {camera: {"format": "png", "data": text}}
            messages[command] = {"x": float(rng.uniform(-1, 1)), "y": float(rng.uniform(-1, 1))}
            for channel, message in messages.items():
                data = json.dumps(message).encode()
                writer.add_message(channel, place * 10**8, data, place * 10**8)
        writer.finish()
