"""Read foreign video files frame by frame, average frames down, and write long videos."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Generator, Iterable, Iterator
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
from acwm_core.env.environment import resolve_size
from acwm_core.errors import DataError

MIN_SIDE = 16
MAX_BYTES = 2**32  # largest size of one episode's frames


class VideoFacts(NamedTuple):
    """Properties stated by a video file: frame size ``(H, W)`` and frames per second."""

    size: tuple[int, int]
    fps: float


def video_facts(path: Path) -> VideoFacts:
    """Read the properties of the MP4 file `path`.

    Raises:
        DataError: it is missing, or not an MP4 video.
    """
    with _opened(path) as (_, stream):
        return VideoFacts((stream.height, stream.width), float(stream.average_rate or 0))


def video_frames(
    path: Path, *, start: float = 0.0, count: int | None = None, fps: float = 0.0
) -> Iterator[NDArray[np.uint8]]:
    """Yield the frames ``[H, W, 3]`` uint8 of the MP4 file `path`.

    Args:
        path: the file; other formats are refused, as FFmpeg's playlists can name other files.
        start: time in seconds at which to begin.
        count: number of frames, `1 / fps` apart; all by default. Reading stops early at the end of
            the file, or if a frame is missing.
        fps: frames per second, needed with `count`.

    Raises:
        DataError: it is missing, not an MP4 video, or damaged.
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


@contextlib.contextmanager
def _opened(path: Path) -> Generator[tuple[Any, Any]]:
    """Open a file and its video stream; FFmpeg errors inside the block become `DataError`s."""
    container: Any  # PyAV's type annotations are incomplete
    try:
        with av.open(str(path), "r", format="mp4", metadata_errors="replace") as container:
            if not container.streams.video:
                raise DataError(f"{path} holds no video")
            stream = container.streams.video[0]
            stream.codec_context.thread_count = 1
            yield container, stream
    except FFmpegError as error:
        raise DataError(f"the video {path} cannot be read ({error.strerror})") from error


def target_size(
    found: tuple[int, int], size: int | tuple[int, int] | None = None
) -> tuple[int, int]:
    """The frame size ``(H, W)`` of a dataset whose videos have the size `found`.

    Args:
        found: size of the videos.
        size: the requested size, a side or a pair; by default `found`, each side rounded down to a
            multiple of 8.

    Raises:
        DataError: the videos are smaller than the requested size, or than 16 pixels.
        ShapeError: a side is not a multiple of 8, or below 16.
    """
    whole = (found[0] // 8 * 8, found[1] // 8 * 8)
    if min(whole) < MIN_SIDE:
        raise DataError(f"frames of {found[0]}×{found[1]} are too small: a side needs {MIN_SIDE}")
    wanted = resolve_size(size, whole)
    if wanted[0] > found[0] or wanted[1] > found[1]:
        raise DataError(
            f"frames of {found[0]}×{found[1]} cannot be enlarged to {wanted[0]}×{wanted[1]}: "
            "give a smaller --size"
        )
    return wanted


def shrunk(frames: Iterable[NDArray[np.uint8]], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Average frames ``[H, W, 3]`` down to `size` one by one; returns ``[T, H, W, 3]``.

    Each new pixel is the mean of the area that it covers.

    Raises:
        DataError: a frame is smaller than `size`, or there are no frames or too many for memory.
    """
    small: list[NDArray[np.uint8]] = []
    most = MAX_BYTES // (size[0] * size[1] * 3)
    for frame in frames:
        target_size((frame.shape[0], frame.shape[1]), size)
        if len(small) == most:
            raise DataError(f"it has more than {most} frames of {size[0]}×{size[1]}: split it")
        if frame.shape[:2] != size:
            rows = _averaged(frame.astype(np.float32), size[0])
            means = _averaged(rows.swapaxes(0, 1), size[1]).swapaxes(0, 1)
            frame = np.rint(means).astype(np.uint8)
        small.append(frame)
    if not small:
        raise DataError("it holds no frame")
    return np.stack(small)


def _averaged(image: NDArray[np.float32], length: int) -> NDArray[np.float32]:
    """The mean of `image` over `length` equal intervals of its first axis."""
    total = np.zeros((length, *image.shape[1:]), np.float32)
    for index, weight in zip(*_intervals(len(image), length), strict=True):
        total += image[index] * weight[:, None, None]
    return total


@functools.cache
def _intervals(old: int, new: int) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """For each interval, the samples that it touches and their shares in it, both ``[K, new]``."""
    edges = np.arange(new + 1) * (old / new)
    touched = np.arange(int(np.ceil(old / new)) + 1)[:, None]
    indices = np.floor(edges[:-1]).astype(np.int64) + touched
    shares: NDArray[Any] = np.minimum(indices + 1, edges[1:]) - np.maximum(indices, edges[:-1])
    weights = np.clip(shares, 0, None)
    return np.minimum(indices, old - 1), (weights / weights.sum(0)).astype(np.float32)


class VideoWriter:
    """Writes one MP4 (H.264, yuv420p, visually lossless) with many episodes in a row.

    There is a key frame at the start of every episode and at least every second, for readers that
    seek.

    Args:
        path: the file.
        size: frame size ``(H, W)``, both even.
        fps: frames per second.

    Attributes:
        frames: number of frames written.
        bytes: number of bytes written, without frames that are still in the encoder.
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
