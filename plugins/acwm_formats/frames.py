"""Frames of videos and pictures: their true times without decoding, and their pixels on request."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple, Protocol, cast

import av
import numpy as np
from av.error import FFmpegError
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray

from acwm_core.data.video import LIMITS, MOST_PIXELS
from acwm_core.errors import DataError
from acwm_core.files import check_fetched
from acwm_formats.channels import STACKED, Channels, channels_of, coloured
from acwm_formats.images import (
    channels_last,
    check_pixels,
    guessed_range,
    is_depth,
    read_image,
    to_rgb,
)
from acwm_formats.mp4_claims import check_mp4
from acwm_formats.sources import present

MOST_FRAMES = 10**7
"""Frames of a recording: four days at 30 per second."""

OPENING = {"max_pixels": str(2 * MOST_PIXELS)}
"""Options of FFmpeg as it opens a file, whose size `check_pixels` can name then."""

MOST_UNPACKED = 2**32
"""Pixels that a video may always unpack to."""

DENSEST = {"gif": 5000}
DENSE = 20_000
"""How many pixels per byte it may unpack to beyond them, by codec: a camera's have a few hundred.
Frames of 4096×4096 that never change have 33,000 in H.264, and unpack for minutes."""

CONTAINERS = {"mp4": (4, b"ftyp moov mdat wide free skip".split()), "gif": (0, [b"GIF8"])} | {
    "matroska": (0, [b"\x1a\x45\xdf\xa3"]),
    "avi": (8, [b"AVI "]),
}
"""FFmpeg's name of a container that is read, and the bytes that it has at a place of its start."""

HDR = (16, 18)  # transfer curves of PQ and HLG, as FFmpeg numbers them
MILLIMETRE = 0.001


class VideoIndex(NamedTuple):
    """What a video file says about its frames, in the order in which they are shown.

    Attributes:
        ticks: presentation times ``[N]`` in units of `base`.
        base: seconds per tick.
        rate: frames per second that the file states; None if it states none.
        size: height and width as shown: upright, with square pixels.
        turns: quarter turns, counterclockwise, that make frames upright.
        depth: whether its pixels are distances: one channel of more than 8 bits.
    """

    ticks: NDArray[np.int64]
    base: Fraction
    rate: Fraction | None
    size: tuple[int, int]
    turns: int
    depth: bool

    @property
    def times(self) -> NDArray[np.float64]:
        """Presentation times ``[N]`` in seconds."""
        return self.ticks * self.base.numerator / self.base.denominator


@dataclass(frozen=True)
class VideoFrames:
    """Frames `first` to `stop` of a video file, counted as they are shown; see `Frames`.

    Attributes:
        path: an MP4, MOV, MKV, WebM, AVI or GIF file, told by its first bytes. FFmpeg's playlists
            are refused, as they can name other files.
        origin: where the recording's clock begins, in seconds of the file.
        unit: metres per number, if it is a depth map.
    """

    path: Path
    first: int = 0
    stop: int | None = None
    origin: float = 0.0
    unit: float = MILLIMETRE

    @property
    def times(self) -> NDArray[np.float64]:
        """As in `Frames`."""
        return video_index(self.path).times[self.first : self.stop] - self.origin

    @property
    def size(self) -> tuple[int, int]:
        """As in `Frames`."""
        return video_index(self.path).size

    @property
    def depth(self) -> bool:
        """As in `Frames`."""
        return video_index(self.path).depth

    @property
    def stamp(self) -> str:
        """As in `Frames`."""
        present(self.path)
        return f"{self.path.name} {self.first} {self.stop} {file_stamp(self.path)}"

    def read(
        self, indices: Sequence[int], depth_range: tuple[float, float] | None = None
    ) -> Iterator[NDArray[np.uint8]]:
        """As in `Frames`."""
        index = video_index(self.path)
        wanted = index.ticks[self.first : self.stop][np.asarray(indices, np.int64)].tolist()
        frames, position, image = _decoded(self.path, wanted[0]), None, np.zeros(0, np.uint8)
        reformatter = VideoReformatter()  # shared, as its setup takes longer than a frame
        for tick in wanted:
            while position is None or position < tick:
                frame = next(frames, None)
                if frame is None:
                    raise DataError(f"the video {self.path} ends before {_at(index, tick)}")
                if frame.pts is not None and frame.pts >= tick:
                    position = frame.pts
                    image = self._pixels(frame, index, depth_range, reformatter)
            if position != tick:
                raise DataError(f"the video {self.path} has no frame {_at(index, tick)}")
            yield image

    def _pixels(
        self,
        frame: Any,
        index: VideoIndex,
        depth_range: tuple[float, float] | None,
        reformatter: VideoReformatter,
    ) -> NDArray[np.uint8]:
        if index.depth:
            metres = frame.to_ndarray().astype(np.float32) * self.unit
            image = to_rgb(metres, depth_range=depth_range)
            return np.ascontiguousarray(np.rot90(image, index.turns))
        size = index.size if index.turns % 2 == 0 else index.size[::-1]
        clear = any(component.is_alpha for component in frame.format.components)
        kind = "rgba" if clear else "rgb24"
        try:
            scaled = reformatter.reformat(frame, format=kind, height=size[0], width=size[1])
        except FFmpegError as error:
            how = f"its pixels, {frame.format.name}, cannot be converted ({error.strerror})"
            raise DataError(f"the video {self.path} cannot be read: {how}") from error
        image = to_rgb(scaled.to_ndarray())
        return np.ascontiguousarray(np.rot90(image, index.turns)) if index.turns else image


def video_index(path: Path) -> VideoIndex:
    """Read where the frames of the video `path` lie in time; only its first frame is decoded.

    It is fetched first if it comes from a URL.

    Raises:
        DataError: it is missing, damaged, not a video that can be read, or of high dynamic range.
    """
    present(path)
    return _index(path, file_stamp(path))


@functools.lru_cache(maxsize=64)
def _index(path: Path, _: str) -> VideoIndex:
    with opened_video(path) as (container, stream):
        ticks = _ticks(path, container, stream)
    with opened_video(path) as (container, stream):
        frame = next(container.decode(stream), None)
        if frame is None:
            raise DataError(f"the video {path} holds no frame that can be decoded")
        if stream.codec_context.color_trc in HDR:
            raise DataError(f"the video {path} has a high dynamic range: convert it to SDR first")
        if frame.rotation % 90:
            raise DataError(
                f"the video {path} is turned by {frame.rotation}°, not by quarter turns"
            )
        turns = frame.rotation // 90 % 4
        aspect = stream.sample_aspect_ratio or Fraction(1)
        width = round(frame.width * aspect) if aspect > 0 else frame.width
        size = (frame.height, width) if turns % 2 == 0 else (width, frame.height)
        check_pixels(f"the video {path}", *size)
        one = len(frame.format.components) == 1 and not frame.format.has_palette
        depth = one and frame.format.components[0].bits > 8
        if frame.pts is not None and frame.pts > min(ticks):  # what comes before is not shown
            ticks = [tick for tick in ticks if tick >= frame.pts]
        ordered = np.array(sorted(ticks), np.int64)
        return VideoIndex(ordered, stream.time_base, stream.average_rate, size, turns, depth)


def _ticks(path: Path, container: Any, stream: Any) -> list[int]:
    """The times of all frames, in the order of the file; nothing is decoded."""
    context, ticks = stream.codec_context, list[int]()
    pixels = max(1, context.height * context.width)
    most = min(MOST_FRAMES, _most_pixels(path, context.name) // pixels)
    for packet in container.demux(stream):
        if not packet.size or packet.is_discard:
            continue
        tick = packet.dts if packet.pts is None else packet.pts
        if tick is None:
            raise DataError(f"the video {path} holds frames without times")
        ticks.append(tick)
        if len(ticks) > most:
            raise DataError(
                f"the video {path} unpacks to more than {most:,} frames of {context.height}×"
                f"{context.width} pixels, too many for its {path.stat().st_size:,} bytes: write it "
                "again as MP4, in parts if it is long"
            )
    if not ticks:
        raise DataError(f"the video {path} holds no frame")
    return ticks


def _most_pixels(path: Path, codec: str) -> int:
    """Pixels that a file may unpack to: in a GIF, a frame may change one pixel of millions."""
    return max(MOST_UNPACKED, DENSEST.get(codec, DENSE) * path.stat().st_size)


def _decoded(path: Path, tick: int) -> Iterator[Any]:
    """Decode from the last key frame before `tick` on, or everything if seeking leads beyond it."""
    with opened_video(path) as (container, stream):
        if tick > (stream.start_time or 0):
            container.seek(tick, stream=stream)
        frames = _sound(path, container, stream)
        if (first := next(frames, None)) is not None and (first.pts or 0) <= tick:
            yield first
            yield from frames
            return
    with opened_video(path) as (container, stream):
        yield from _sound(path, container, stream)


def _sound(path: Path, container: Any, stream: Any) -> Iterator[Any]:
    """Decode, and report damage instead of concealing it."""
    context = stream.codec_context
    context.options = {"err_detect": "explode", **LIMITS}
    most = context.height * context.width or MOST_PIXELS
    for frame in container.decode(stream):
        if frame.height * frame.width > most:
            raise DataError(f"the video {path} has larger frames from {frame.time or 0:.3f} s on")
        if frame.is_corrupt:
            raise DataError(f"the video {path} is damaged at {frame.time or 0:.3f} s")
        yield frame


@contextlib.contextmanager
def opened_video(path: Path) -> Generator[tuple[Any, Any]]:
    """Open a file and its video stream; FFmpeg errors inside the block become `DataError`s.

    Raises:
        DataError: it is no video that is read, or claims more than it can hold.
    """
    container: Any  # PyAV's type annotations are incomplete
    check_fetched(path)
    kind = container_of(path)
    if kind is None:
        raise DataError(f"{path} is not an MP4, MOV, MKV, WebM, AVI or GIF file")
    if kind == "mp4":
        check_mp4(path)
    place = str(path.absolute())  # "concat:a" would be a protocol of FFmpeg
    try:
        with av.open(
            place, "r", format=kind, metadata_errors="replace", options=OPENING
        ) as container:
            if not container.streams.video:
                raise DataError(f"{path} holds no video")
            stream = container.streams.video[0]
            context = stream.codec_context
            if context is None:
                raise DataError(f"the video {path} is in a codec that FFmpeg does not know")
            check_pixels(f"the video {path}", context.height, context.width)
            context.options = LIMITS
            context.thread_count = 1
            yield container, stream
    except FFmpegError as error:
        raise DataError(f"the video {path} cannot be read ({error.strerror})") from error


def container_of(path: Path) -> str | None:
    """FFmpeg's name of the container of a file, told by its first bytes; None for other files."""
    with path.open("rb") as file:
        start = file.read(12)
    for name, (place, marks) in CONTAINERS.items():
        if any(start[place:].startswith(mark) for mark in marks):
            return name
    return None


def file_stamp(path: Path) -> str:
    """Size and date of a file, which change when it does."""
    try:
        status = path.stat()
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror})") from error
    return f"{status.st_size} {status.st_mtime_ns}"


def _at(index: VideoIndex, tick: int) -> str:
    return f"at {float(tick * index.base):.3f} s"


class Images(Protocol):
    """Images by index: a list, an array, or an object that reads them on request."""

    def __len__(self) -> int:
        """Number of images."""
        ...

    def __getitem__(self, index: int, /) -> Any:
        """An array, the path of a picture, or the bytes of one."""
        ...


@dataclass(frozen=True)
class ImageFrames:
    """Frames in memory or in files of pictures, with times of their own; see `Frames`.

    Attributes:
        images: one for each frame.
        times: ``[N]`` in seconds.
        pixel_range: the values that are black and white, see `to_rgb`; guessed from the first image
            by default.
        unit: metres per whole number, if they are depth maps; floating-point ones are in metres.
        channels: what three or four channels of arrays are; found out by default.
        stamp: as in `Frames`.
    """

    images: Images
    times: NDArray[np.float64]
    pixel_range: tuple[float, float] | None = None
    unit: float = MILLIMETRE
    channels: Channels | None = None
    stamp: str = ""

    @functools.cached_property
    def _first(self) -> NDArray[Any]:
        if not len(self.images):
            raise DataError("it holds no frame")
        return _image(self.images[0])

    @functools.cached_property
    def colour_order(self) -> Channels | None:
        """What the channels are; None if they are grey, depth, or those that a file of one names.

        Raises:
            DataError: it cannot be told.
        """
        count = channels_last(self._first).shape[2]
        if isinstance(self.images[0], str | Path | bytes) or count == 1:
            return None
        if self.channels is None:
            return channels_of(cast(Sequence[Any], self.images), np.asarray)
        if self.channels == ("rgba" if count == 3 else "rgb"):
            raise DataError(f"its frames have {count} channels, not {self.channels}")
        return self.channels

    @property
    def size(self) -> tuple[int, int]:
        """As in `Frames`."""
        height, width = channels_last(self._first).shape[:2]
        return height, width

    @property
    def depth(self) -> bool:
        """As in `Frames`."""
        return is_depth(self._first)

    def read(
        self, indices: Sequence[int], depth_range: tuple[float, float] | None = None
    ) -> Iterator[NDArray[np.uint8]]:
        """As in `Frames`."""
        pixel_range = self.pixel_range or guessed_range(self._first)
        channels = self.colour_order
        for index in indices:
            image = _image(self.images[index])
            image = image if channels is None else coloured(image, channels)
            if self.depth and image.dtype.kind != "f":
                image = image.astype(np.float32) * self.unit
            yield to_rgb(image, depth_range=depth_range, pixel_range=pixel_range)


def _image(image: Any) -> NDArray[Any]:
    if isinstance(image, str | Path | bytes):
        return read_image(Path(image) if isinstance(image, str) else image)
    return np.asarray(image)


def regular_times(count: int, rate: float | Fraction) -> NDArray[np.float64]:
    """Times of `count` frames at a constant rate, from 0.

    Raises:
        DataError: there are more than `MOST_FRAMES`.
    """
    if count > MOST_FRAMES:
        raise DataError(f"it claims {count:,} frames, but at most {MOST_FRAMES:,} are read")
    return np.arange(count) / float(rate) if math.isfinite(rate) else np.zeros(count)


def stack_note(frames: Iterable[object]) -> list[str]:
    """A sentence for people if some frames are stacks of moments, of which one is shown.

    Raises:
        DataError: frames cannot be read.
    """
    stacks = {
        STACKED.format(
            channels=stack.colour_order, count=channels_last(np.asarray(stack.images[0])).shape[2]
        )
        for stack in frames
        if isinstance(stack, ImageFrames) and stack.colour_order in ("newest-last", "newest-first")
    }
    return sorted(stacks)
