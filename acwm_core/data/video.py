"""Encode and decode video: bit-exact for shards, and small MP4 files for people to watch.

Frames are stored as lossless H.264 in RGB (no colour conversion), masks as grey FFV1, both in
Matroska. Key frames let a clip be decoded without the whole video before it. With one thread and
FFmpeg's bit-exact mode, equal frames give equal bytes.
"""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import av
import numpy as np
from av.codec.context import Flags
from av.error import FFmpegError
from numpy.typing import NDArray

from acwm_core.data.pictures import enlarge
from acwm_core.env.card import exact_rate
from acwm_core.errors import DataError, ShapeError
from acwm_core.files import written_whole

# x264 does not guarantee that decisions of its lookahead are reproducible.
REPEATABLE = {"bf": "0", "weightp": "0", "sc_threshold": "0", "rc-lookahead": "0"}


@dataclass(frozen=True)
class Encoding:
    """FFmpeg's names of the input pixel format, the stored pixel format, codec and container."""

    pixels: str
    stored: str
    codec: str
    options: Mapping[str, str]
    container: str = "matroska"


# No arithmetic coding: it would halve the decoding speed and save only a tenth of the bytes.
_LOSSLESS = {"qp": "0", "preset": "medium", "coder": "0", **REPEATABLE}
VIDEO = Encoding("rgb24", "rgb24", "libx264rgb", _LOSSLESS)
MASK = Encoding("gray", "gray", "ffv1", {"level": "1", "coder": "1"})
_SMALL = {"crf": "18", "preset": "veryfast", **REPEATABLE}
MP4 = Encoding("rgb24", "yuv420p", "libx264", _SMALL, "mp4")
KEYFRAMES = 16
"""Number of frames from one key frame of a video to the next."""

MOST_PIXELS = 2**26
"""Pixels of a frame. Few bytes can claim more, and unpacking them would take all memory."""

LIMITS = {"max_pixels": str(MOST_PIXELS)}
"""Options of FFmpeg for files of strangers."""

PLANES_OF_RGB = (2, 0, 1)  # FFmpeg's planar RGB is ordered green, blue, red


def encode_video(frames: NDArray[np.uint8], fps: float = 10) -> bytes:
    """Lossless Matroska bytes of frames ``[T, H, W, 3]`` uint8.

    Raises:
        ShapeError: not uint8 ``[T, H, W, 3]``, or no frame at all.
    """
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or not len(frames):
        raise ShapeError(f"video is {frames.dtype} {frames.shape}, not uint8 [T, H, W, 3]")
    return encode_frames(frames, frames.shape[1:3], VIDEO, fps, keyframes=KEYFRAMES)


def encode_masks(masks: NDArray[np.uint8], fps: float = 10) -> bytes:
    """Lossless Matroska bytes of instance ids ``[T, H, W]`` uint8.

    Raises:
        ShapeError: not uint8 ``[T, H, W]``, or no frame at all.
    """
    if masks.dtype != np.uint8 or masks.ndim != 3 or not len(masks):
        raise ShapeError(f"masks are {masks.dtype} {masks.shape}, not uint8 [T, H, W]")
    return encode_frames(masks, masks.shape[1:], MASK, fps, keyframes=len(masks))


def decode_planes(
    data: bytes,
    start: int = 0,
    stop: int | None = None,
    *,
    size: Sequence[int] | None = None,
    length: int | None = None,
) -> NDArray[np.uint8]:
    """Frames `start` to `stop` of `encode_video`'s bytes, as ``[T, 3, H, W]`` uint8.

    Args:
        data: the bytes.
        start: the first frame.
        stop: the frame after the last; all by default.
        size: height and width that they must have. Few bytes can hold more than the memory, so name
            it for files of strangers.
        length: number of frames that all must be, if `stop` is not given.

    Raises:
        DataError: the bytes are not a video of this size and length, or it ends before `stop`.
    """
    decoded: list[NDArray[np.uint8]] = []
    for frame in _expected(_decode(data, start, stop), size, length):
        decoded.append(np.empty((3, frame.height, frame.width), np.uint8))
        _copy_planes(frame, decoded[-1])
    return _complete(decoded, start, stop)


def decode_into(target: NDArray[np.uint8], data: bytes, start: int) -> None:
    """Decode from frame `start` on until `target` ``[T, 3, H, W]`` uint8 is full.

    This fills a batch with a single copy of each pixel.

    Raises:
        DataError: the bytes are not a video of this size, or it ends before `target` is full.
    """
    index = -1
    for index, frame in enumerate(_decode(data, start, start + len(target))):
        if (frame.height, frame.width) != target.shape[2:]:
            raise DataError(_other_size(frame, target.shape[2:]))
        _copy_planes(frame, target[index])
    if index + 1 != len(target):
        raise DataError(f"it ends before frame {start + len(target)}: {index + 1} frames decoded")


def _copy_planes(frame: av.VideoFrame, target: NDArray[np.uint8]) -> None:
    if frame.format.name == "gbrp":
        for place, plane in enumerate(PLANES_OF_RGB):
            target[place] = plane_of(frame, plane)
    else:  # FFmpeg's own conversion to planes leaves the last columns of some widths unset
        image: NDArray[Any] = frame.to_ndarray(format="rgb24")
        target[:] = image.transpose(2, 0, 1)


def decode_video(
    data: bytes,
    start: int = 0,
    stop: int | None = None,
    *,
    size: Sequence[int] | None = None,
    length: int | None = None,
) -> NDArray[np.uint8]:
    """`decode_planes` as ``[T, H, W, 3]`` uint8."""
    planes = decode_planes(data, start, stop, size=size, length=length)
    return np.ascontiguousarray(planes.transpose(0, 2, 3, 1))


def decode_masks(
    data: bytes, *, size: Sequence[int] | None = None, length: int | None = None
) -> NDArray[np.uint8]:
    """Instance ids ``[T, H, W]`` uint8 from `encode_masks`' bytes; as `decode_planes` otherwise."""
    frames = _expected(_decode(data, 0, None), size, length)
    return _complete([plane_of(frame, 0).copy() for frame in frames], 0, None)


def _expected(
    frames: Iterator[av.VideoFrame], size: Sequence[int] | None, length: int | None
) -> Iterator[av.VideoFrame]:
    """The frames, as long as they have a size and are no more than a number."""
    for index, frame in enumerate(frames):
        if size is not None and (frame.height, frame.width) != tuple(size):
            raise DataError(_other_size(frame, size))
        if length is not None and index >= length:
            raise DataError(f"it has more than {length} frames")
        yield frame


def _other_size(frame: av.VideoFrame, size: Sequence[int]) -> str:
    return f"its frames are {frame.height}×{frame.width}, not {size[0]}×{size[1]}"


def write_mp4(
    target: Path | IO[bytes], frames: Iterable[NDArray[np.uint8]], fps: float = 10, scale: int = 1
) -> None:
    """Write frames as an MP4 (H.264, yuv420p) that every browser plays.

    Args:
        target: a path, or a seekable binary file, e.g. `io.BytesIO` to embed in a page.
        frames: ``[T, H, W, 3]`` uint8, or an iterable of single frames if all would not fit in
            memory. Of an odd height or width the last row or column is cut off, as yuv420p needs
            even ones.
        scale: integer factor by which each pixel is enlarged, without blurring.

    Raises:
        ShapeError: not uint8 ``[T, H, W, 3]``, or no frame at all.
    """
    even = (_even(frame, scale) for frame in frames)
    first = next(even, None)
    if first is None:
        raise ShapeError("a video needs at least one frame")
    frames = itertools.chain([first], even)
    data = encode_frames(frames, first.shape[:2], MP4, fps, keyframes=math.ceil(5 * fps))
    if isinstance(target, Path):
        with written_whole(target) as partial:
            partial.write_bytes(data)
    else:
        target.write(data)


def _even(frame: NDArray[np.uint8], scale: int) -> NDArray[np.uint8]:
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise ShapeError(f"a frame is {frame.dtype} {frame.shape}, not uint8 [H, W, 3]")
    large = enlarge(frame, scale)
    return large[: len(large) // 2 * 2, : large.shape[1] // 2 * 2]


def encode_frames(
    images: Iterable[NDArray[np.uint8]],
    size: Sequence[int],
    encoding: Encoding,
    fps: float,
    keyframes: int,
) -> bytes:
    """Encode images of height and width `size` in one thread.

    Every `keyframes`-th frame is a key frame.
    """
    buffer = io.BytesIO()
    output: Any  # PyAV's annotations leave half of their types open
    with av.open(buffer, "w", format=encoding.container, options={"fflags": "+bitexact"}) as output:
        stream = output.add_stream(encoding.codec, rate=exact_rate(fps))
        stream.height, stream.width = size
        stream.pix_fmt = encoding.stored
        stream.options = dict(encoding.options)
        stream.gop_size = keyframes
        stream.codec_context.flags |= Flags.bitexact
        stream.codec_context.thread_count = 1
        for image in images:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=encoding.pixels)
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return buffer.getvalue()


def _decode(data: bytes, start: int, stop: int | None) -> Iterator[av.VideoFrame]:
    """Decode frames in order, in one thread, because loaders run many decoders in parallel."""
    source: Any
    try:
        with av.open(io.BytesIO(data), "r", format="matroska", options=LIMITS) as source:
            stream = source.streams.video[0]
            stream.codec_context.thread_count = 1
            # Report damage instead of concealing it.
            stream.codec_context.options = {"err_detect": "explode", **LIMITS}
            index, frames = 0, source.decode(stream)
            if start >= KEYFRAMES:
                first, index = _sought(source, stream, start)
                frames = itertools.chain([first], source.decode(stream))
            for frame in frames:
                if stop is not None and index >= stop:
                    return
                if index >= start:
                    yield frame
                index += 1
    except FFmpegError as error:
        raise DataError(f"it cannot be decoded ({error.strerror})") from error


def _sought(source: Any, stream: Any, start: int) -> tuple[av.VideoFrame, int]:
    """The first frame from the last key frame before `start` on, and its index."""
    rate = stream.average_rate
    source.seek(int((start + 0.5) / rate / stream.time_base), stream=stream)
    first = next(source.decode(stream), None)
    if first is None:
        raise DataError(f"it ends before frame {start}")
    return first, round(first.pts * stream.time_base * rate)


def plane_of(frame: av.VideoFrame, index: int) -> NDArray[Any]:
    """Plane `index` of a decoded frame, `[H, W]`: a view without the rows' padding."""
    plane: Any = frame.planes[index]
    pixels = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    return pixels[:, : plane.width]


def _complete(decoded: list[NDArray[np.uint8]], start: int, stop: int | None) -> NDArray[np.uint8]:
    if not decoded or (stop is not None and len(decoded) != stop - start):
        wanted = f"frames {start} to {stop}" if stop is not None else "a single frame"
        raise DataError(f"it ends before {wanted}: {len(decoded)} frames decoded")
    return np.stack(decoded)
