"""The format MCAP: logs of robots, with compressed images or video, and a topic of numbers."""

from __future__ import annotations

import base64
import contextlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray
from PIL import Image

from acwm_core.errors import DataError, suggest
from acwm_core.files import check_fetched
from acwm_formats.format import Format
from acwm_formats.frames import ImageFrames, file_stamp
from acwm_formats.mcap_clocks import Stamps, TopicClock, clock_note, times_of
from acwm_formats.mcap_images import CameraMessages, is_image, is_video
from acwm_formats.mcap_messages import (
    MAGIC,
    NumberMessages,
    Numbers,
    TextMessages,
    descriptions,
    entries,
    topics,
)
from acwm_formats.names import unread_note, word, words
from acwm_formats.sources import damage_of, files_in, guarded
from acwm_formats.texts import Fact, text_note
from acwm_formats.timeline import (
    ActionFacts,
    RecordedDataset,
    Samples,
    TimedRecording,
    first_sound,
)


class Log(NamedTuple):
    """What one file is read by.

    Attributes:
        cameras: the topics of images.
        actions: the topic of actions, perhaps followed by a colon and a field.
        states: topics of states, in the same way.
        stamps: whose times to take.
        texts: topics that may hold texts, which are kept as facts.
    """

    cameras: tuple[str, ...]
    actions: str
    states: tuple[str, ...]
    stamps: Stamps | None = None
    texts: tuple[str, ...] = ()


class MCAP(Format):
    """MCAP files with messages in JSON, ROS 2 or Protobuf; read only."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether it is or holds MCAP files."""
        return bool(_files(path))

    @guarded
    def read(
        self,
        root: Path,
        *,
        video: str | None = None,
        actions: str | None = None,
        states: str | None = None,
        stamps: Stamps | None = None,
        follow_links: bool = False,
    ) -> RecordedDataset:
        """Import an MCAP file, or a folder of them, one episode each.

        Messages of images (CompressedImage of ROS 2 or Foxglove), of video (CompressedVideo of
        Foxglove in H.264 or H.265) and of numbers are matched by the times in their headers, or by
        the times of the log if the headers share no clock.

        Args:
            root: the file or folder.
            video: Topics of images or video, with a comma between; all by default.
            actions: Topic of the actions, or TOPIC:FIELD; by default the only one with numbers.
            states: Topics of the states, or TOPIC:FIELD, with a comma between; none by default.
            stamps: Which times to use; by default those in the headers, if they share the log's
                clock or all messages have them.
            follow_links: Whether links may lead out of the folder.
        """
        root = Path(root)
        files = _files(root)
        if not files:
            raise DataError(f"{root} is not an MCAP file and contains none")
        first = first_sound(files, topics)
        kinds = topics(first)
        filmed = [topic for topic, kind in kinds.items() if is_image(kind) or is_video(kind)]
        cameras = words(video) or tuple(filmed)
        if not cameras:
            raise DataError(f"{first} has no topic of images or video, only {_told(kinds)}")
        asked = [state.partition(":")[0] for state in words(states)] + [
            (actions or "").partition(":")[0]
        ]
        for topic in (*cameras, *filter(None, asked)):
            if topic not in kinds:
                raise DataError(f"{first} has no topic {topic!r}{suggest(topic, kinds)}")
        wanted, numbers = _actions(first, actions, [t for t in kinds if t not in filmed])
        used = {*cameras, wanted.partition(":")[0], *asked}
        others = [topic for topic in kinds if topic not in used]
        log = Log(cameras, wanted, words(states), stamps, _text_topics(first, others))
        return RecordedDataset(
            name=word(root),
            splits=Logs(tuple(files), log),
            facts={"kind": "mcap", "name": root.resolve().name, "files": len(files)}
            | {"bytes": sum(path.stat().st_size for path in files)},
            options={"video": video, "actions": actions, "states": states, "stamps": stamps}
            | {"follow_links": follow_links},
            actions=ActionFacts(numbers.names),
            notes=_notes(first, log, [topic for topic in others if topic not in log.texts])
            + tuple(unread_note(root, files)),
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
        """Open one file; times count from its first frame that can be shown.

        Frames of a video before its first key frame cannot, so it has fewer than it claims.
        """
        path, log = self.files[index], self.log
        with damage_of(path):
            return self._opened(path, log)

    def _opened(self, path: Path, log: Log) -> TimedRecording:
        cameras, columns, texts = _read(path, log)
        numbers = {name: column.numbers() for name, column in columns.items()}
        times = times_of(_clocks(cameras, numbers), log.stamps)
        zero = min(
            (int(times[camera.topic][0]) for camera in cameras if len(camera.times)), default=0
        )

        def samples(name: str) -> Samples:
            return Samples(numbers[name].rows, (times[name] - zero) / 1e9)

        return TimedRecording(
            path.name,
            {_name(c.topic): _frames(path, c, (times[c.topic] - zero) / 1e9) for c in cameras},
            samples(log.actions),
            {_name(name): samples(name) for name in log.states},
            facts=texts,
            length=cameras[0].logged if cameras[0].logged > len(cameras[0].times) else None,
        )


def _read(
    path: Path, log: Log
) -> tuple[list[CameraMessages], dict[str, NumberMessages], dict[str, Fact]]:
    """What a file holds of the topics that are asked for, and what it says in words."""
    cameras = [CameraMessages(topic) for topic in log.cameras]
    columns = {name: NumberMessages(name) for name in (log.actions, *log.states)}
    texts = [TextMessages(topic) for topic in log.texts]
    _gathered(path, (*cameras, *columns.values(), *texts))
    said = descriptions(path)
    for topic in texts:
        said |= topic.facts()
    return cameras, columns, said


def _text_topics(path: Path, others: Sequence[str]) -> tuple[str, ...]:
    """The topics that hold texts and no numbers, by their first messages."""
    known: dict[str, TextMessages] = {}
    for entry in entries(path, others) if others else ():
        if entry.topic not in known:
            known[entry.topic] = TextMessages(entry.topic)
            known[entry.topic].add(entry)
    return tuple(topic for topic, texts in known.items() if texts.facts())


def _clocks(
    cameras: Sequence[CameraMessages], numbers: Mapping[str, Numbers]
) -> dict[str, TopicClock]:
    clocks = {camera.topic: TopicClock(camera.times, camera.stamps) for camera in cameras}
    return clocks | {name: TopicClock(topic.times, topic.stamps) for name, topic in numbers.items()}


def _notes(path: Path, log: Log, others: Sequence[str]) -> tuple[str, ...]:
    """What people should know about how the logs were read, by the first."""
    cameras, columns, texts = _read(path, log)
    known: dict[str, Numbers] = {}
    with contextlib.suppress(DataError):  # opening it will tell
        known = {name: column.numbers() for name, column in columns.items()}
    note = clock_note(_clocks(cameras, known), log.stamps)
    notes = [f"Actions are {log.actions}; {note}."]
    if others:
        notes.append(f"Topics that were left out: {', '.join(others)}.")
    return (*notes, *text_note(texts))


def _gathered(
    path: Path, gatherers: Sequence[CameraMessages | NumberMessages | TextMessages]
) -> None:
    """Give each message of the file to those who gather its topic, in one scan."""
    by_topic: dict[str, list[CameraMessages | NumberMessages | TextMessages]] = {}
    for gatherer in gatherers:
        by_topic.setdefault(gatherer.topic, []).append(gatherer)
    for entry in entries(path, list(by_topic)):
        for gatherer in by_topic[entry.topic]:
            gatherer.add(entry)


def _frames(path: Path, camera: CameraMessages, times: NDArray[np.float64]) -> ImageFrames:
    stamp = f"{camera.topic} {file_stamp(path)}"
    return ImageFrames(camera.images(path), times, channels="rgb", stamp=stamp)


def _name(topic: str) -> str:
    return topic.strip("/").replace("/", ".")


def _files(path: Path) -> list[Path]:
    if path.is_file():
        check_fetched(path)
        with path.open("rb") as file:
            return [path] if file.read(len(MAGIC)) == MAGIC else []
    return files_in(path, [".mcap"]) if path.is_dir() else []


def _actions(path: Path, wanted: str | None, others: Sequence[str]) -> tuple[str, Numbers]:
    """The topic of actions, which is wanted or the only one with numbers, and its numbers."""
    columns = {name: NumberMessages(name) for name in ([wanted] if wanted else others)}
    _gathered(path, [*columns.values()])
    if wanted:
        return wanted, columns[wanted].numbers()
    topics = [name for name, column in columns.items() if column.rows and column.problem is None]
    if len(topics) != 1:
        raise DataError(
            f"{path} has {len(topics)} topics of numbers ({', '.join(topics)}): "
            "give --actions TOPIC"
        )
    return topics[0], columns[topics[0]].numbers()


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
