"""Video files of others: frames one at a time, and a long film written episode by episode."""

from __future__ import annotations

import math
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from av.codec.context import Flags
from av.error import FFmpegError
from av.video.frame import PictureType
from numpy.typing import NDArray

from acwm_core.data.video import MP4
from acwm_core.errors import DataError

MOST_PIXELS = 2**25
"""Of a frame: a little more than 8K video has."""


class Film(NamedTuple):
    """What a video file says of itself: frame size ``(H, W)`` and frames per second."""

    size: tuple[int, int]
    fps: float


def film_of(path: Path) -> Film:
    """Look into the MP4 file `path`.

    Raises:
        DataError: it is missing, no MP4 video, or of an absurd size.
    """
    with _opened(path) as (_, stream):
        return Film((stream.height, stream.width), float(stream.average_rate or 0))


def film_frames(
    path: Path, *, start: float = 0.0, count: int | None = None, fps: float = 0.0
) -> Iterator[NDArray[np.uint8]]:
    """Frames ``[H, W, 3]`` uint8 of the MP4 file `path`, one at a time.

    Args:
        path: the file; anything but MP4 is refused, as FFmpeg's playlists can name other files.
        start: seconds at which to begin.
        count: how many frames, `1 / fps` apart; all by default. It ends early if the file does,
            or if it lacks one.
        fps: frames per second, needed with `count`.

    Raises:
        DataError: it is missing, no MP4 video, or damaged.
    """
    with _opened(path) as (container, stream):
        if start > 0:
            base = float(stream.time_base)
            container.seek(max(0, math.floor((start - 0.5 / fps) / base)), stream=stream)
        expected = 0
        for frame in container.decode(stream):
            if count is None:
                yield frame.to_ndarray(format="rgb24")
                continue
            position = round(((frame.time or 0.0) - start) * fps)
            if position > expected or expected >= count:
                return
            if position == expected:
                yield frame.to_ndarray(format="rgb24")
                expected += 1


class _opened:
    """An open file and its video stream; FFmpeg's errors inside become `DataError`s."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> tuple[Any, Any]:
        try:
            self._container: Any = av.open(str(self._path), "r", format="mp4")
        except FFmpegError as error:
            raise self._error(error) from error
        streams = self._container.streams.video
        if not streams:
            self._container.close()
            raise DataError(f"{self._path} holds no video")
        stream = streams[0]
        if not 0 < stream.height * stream.width <= MOST_PIXELS:
            self._container.close()
            raise DataError(f"{self._path} claims frames of {stream.height}×{stream.width}")
        stream.codec_context.thread_count = 1
        return self._container, stream

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._container.close()
        if isinstance(error, FFmpegError):
            raise self._error(error) from error

    def _error(self, error: FFmpegError) -> DataError:
        return DataError(f"the video {self._path} cannot be read ({error.strerror})")


class FilmWriter:
    """Writes one MP4 (H.264, yuv420p, visually lossless) of many episodes one after another.

    Every episode begins with a key frame, and so does every second, for readers that seek.

    Args:
        path: the file.
        size: frame size ``(H, W)``, both even.
        fps: frames per second.

    Attributes:
        frames: how many were written.
        bytes: how many they take, not counting those still in the encoder.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: int) -> None:
        self.frames = self.bytes = 0
        self._fps = fps
        options = {"fflags": "+bitexact"}
        self._output: Any = av.open(str(path), "w", format="mp4", options=options)
        self._stream: Any = self._output.add_stream(MP4.codec, rate=fps)
        self._stream.height, self._stream.width = size
        self._stream.pix_fmt = MP4.stored
        self._stream.options = dict(MP4.options)
        self._stream.gop_size = fps
        self._stream.codec_context.flags |= Flags.bitexact
        self._stream.codec_context.thread_count = 1  # for equal bytes everywhere

    def add(self, episode: NDArray[np.uint8]) -> None:
        """Write the frames ``[T, H, W, 3]`` uint8 of one episode."""
        for index, image in enumerate(episode):
            frame: Any = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = self.frames, Fraction(1, self._fps)
            if index == 0:
                frame.pict_type = PictureType.I
            self._mux(frame)
            self.frames += 1

    def close(self) -> None:
        """Finish the file."""
        self._mux(None)
        self._output.close()

    def _mux(self, frame: Any) -> None:
        for packet in self._stream.encode(frame):
            self.bytes += packet.size
            self._output.mux(packet)
