"""Frames in MCAP files: messages of compressed images, and of video in H.264 or H.265."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from acwm_core.data.video import LIMITS
from acwm_core.errors import DataError
from acwm_formats.frames import HDR
from acwm_formats.images import to_rgb
from acwm_formats.mcap_messages import LoggedMessage, content_of, entries, stamp_of

START = re.compile(rb"\x00\x00\x01(..?)", re.S)
"""The start of a unit in the byte stream of Annex B, and its header."""

CODECS = {"h264": "h264", "h265": "hevc", "hevc": "hevc"}
"""FFmpeg's name of a codec by that of the schema."""


def is_image(kind: str) -> bool:
    """Whether a schema is one of compressed images."""
    return _last(kind) == "CompressedImage"


def is_video(kind: str) -> bool:
    """Whether a schema is one of frames of a video."""
    return _last(kind) == "CompressedVideo"


def _last(kind: str) -> str:
    return re.split(r"[./]", kind)[-1]


def data_of(entry: LoggedMessage) -> bytes:
    """The bytes of a picture or of a frame.

    Raises:
        DataError: the message holds none.
    """
    data = content_of(entry.content(), "data")
    if data is None or not (is_image(entry.kind) or is_video(entry.kind)):
        raise DataError(f"{entry.topic} holds no compressed images, but {entry.kind}")
    return base64.b64decode(data) if isinstance(data, str) else bytes(data)


def codec_of(entry: LoggedMessage) -> str:
    """FFmpeg's name of the codec of a message of video.

    Raises:
        DataError: it is another than H.264 or H.265, or not as a byte stream.
    """
    name = str(content_of(entry.content(), "format")).lower()
    again = "write it as MP4 and import a folder of videos"
    if name not in CODECS:
        raise DataError(f"{entry.topic} is video in {name}; H.264 and H.265 are read: {again}")
    if not data_of(entry).startswith((b"\x00\x00\x01", b"\x00\x00\x00\x01")):
        raise DataError(f"{entry.topic} is {name}, but not in Annex B: {again}")
    return CODECS[name]


def is_key(data: bytes, codec: str) -> bool:
    """Whether a frame can be decoded without those before it."""
    headers = (match[1][0] for match in START.finditer(data))
    if codec == "h264":
        return any(header & 31 == 5 for header in headers)
    return any(16 <= header >> 1 & 63 <= 21 for header in headers)


class _Logged(Sequence[Any]):
    """Frames of a topic, which are best asked for in order."""

    def __init__(self, path: Path, topic: str, count: int) -> None:
        self._path, self._topic, self._count = path, topic, count
        self._rest: Iterator[Any] | None = None
        self._next, self._image = 0, None

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_rest": None, "_next": 0, "_image": None}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, index: Any) -> Any:
        if self._rest is None or index < self._next - 1:
            self._rest, self._next = self._all(), 0
        while self._next <= index:
            self._image = next(self._rest, None)
            if self._image is None:
                raise DataError(f"{self._topic} of {self._path} ends before frame {index}")
            self._next += 1
        return self._image

    def _all(self) -> Iterator[Any]:
        raise NotImplementedError


class LoggedImages(_Logged):
    """The pictures of a topic."""

    def _all(self) -> Iterator[bytes]:
        return (data_of(entry) for entry in entries(self._path, [self._topic]))


class LoggedVideo(_Logged):
    """The frames of a topic of video, from its first key frame on, one per message."""

    def __init__(self, path: Path, topic: str, count: int, codec: str, first: int) -> None:
        super().__init__(path, topic, count)
        self._codec, self._first = codec, first

    def _all(self) -> Iterator[NDArray[np.uint8]]:
        decoder: Any = av.CodecContext.create(self._codec, "r")
        decoder.thread_count = 1
        decoder.options = {"err_detect": "explode", **LIMITS}
        try:
            for place, frame in enumerate(self._decoded(decoder)):
                if frame.pts != place:
                    raise self._wrong(
                        f"message {min(frame.pts, place) + self._first} does not decode to "
                        "the next frame: frames are missing, or there are B-frames, which the "
                        "schema forbids"
                    )
                if decoder.color_trc in HDR:
                    raise self._wrong("it has a high dynamic range: convert it to SDR first")
                if frame.is_corrupt:
                    raise self._wrong(f"message {place + self._first} is damaged")
                yield to_rgb(frame.to_ndarray(format="rgb24"))
        except FFmpegError as error:
            raise self._wrong(f"it cannot be decoded ({error.strerror})") from error

    def _decoded(self, decoder: Any) -> Iterator[Any]:
        for place, entry in enumerate(entries(self._path, [self._topic])):
            if place >= self._first:
                packet = av.Packet(data_of(entry))
                packet.pts = packet.dts = place - self._first
                yield from decoder.decode(packet)
        yield from decoder.decode(None)

    def _wrong(self, what: str) -> DataError:
        return DataError(f"the video {self._topic} of {self._path}: {what}")


class CameraMessages:
    """Gathers the times of a topic's frames, and makes them readable."""

    def __init__(self, topic: str) -> None:
        self.topic, self._times, self._stamps = topic, list[int](), list[int]()
        self._codec, self._first = "", 0
        self._before = True  # the first key frame

    def add(self, entry: LoggedMessage) -> None:
        """Note when a frame was logged; of a video, look for the first key frame."""
        if self._before and is_video(entry.kind):
            self._codec = self._codec or codec_of(entry)
            self._before = not is_key(data_of(entry), self._codec)
            self._first += self._before
        self._times.append(entry.time)
        self._stamps.append(stamp_of(entry.content()))

    @property
    def times(self) -> NDArray[np.int64]:
        """When each frame that can be decoded was logged, ``[N]`` in ns."""
        return np.array(self._times[self._first :], np.int64)

    @property
    def stamps(self) -> NDArray[np.int64]:
        """The times in the headers of the same frames, ``[N]`` in ns; 0 if there are none."""
        return np.array(self._stamps[self._first :], np.int64)

    @property
    def logged(self) -> int:
        """Number of messages."""
        return len(self._times)

    def images(self, path: Path) -> Sequence[Any]:
        """The frames."""
        count = len(self._times) - self._first
        if not self._codec:
            return LoggedImages(path, self.topic, count)
        return LoggedVideo(path, self.topic, count, self._codec, self._first)
