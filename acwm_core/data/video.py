"""Video to bytes and back: bit-exact for shards, and small MP4 files for people to look at.

Frames are stored as lossless H.264 in RGB (no colour conversion), masks as grey FFV1, both in
Matroska. On 66-frame episodes of the pushing scene lossless H.264 takes a third of FFV1's bytes
and a sixth of its decoding time, because most of a frame repeats the last one.
One encoder thread and FFmpeg's bit-exact mode make equal frames equal bytes in every process.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import av
import numpy as np
from av.codec.context import Flags
from av.error import FFmpegError
from numpy.typing import NDArray

from acwm_core.errors import DataError, ShapeError

# x264 does not promise to repeat what it decides by looking ahead.
REPEATABLE = {"bf": "0", "weightp": "0", "sc_threshold": "0", "rc-lookahead": "0"}
# No arithmetic coding, which would halve the speed of decoding for a tenth of the bytes.
LOSSLESS = {"qp": "0", "preset": "medium", "coder": "0", **REPEATABLE}
MASK = {"level": "1", "coder": "1"}
PREVIEW = {"crf": "18", "preset": "veryfast", **REPEATABLE}
PLANES_OF_RGB = (2, 0, 1)  # FFmpeg's planar RGB is ordered green, blue, red


def encode_video(frames: NDArray[np.uint8], fps: int = 10) -> bytes:
    """Lossless Matroska bytes of frames ``[T, H, W, 3]`` uint8.

    Raises:
        ShapeError: not uint8 ``[T, H, W, 3]``, or no frame at all.
    """
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or not len(frames):
        raise ShapeError(f"video is {frames.dtype} {frames.shape}, not uint8 [T, H, W, 3]")
    return _encode(frames, "rgb24", "libx264rgb", "rgb24", LOSSLESS, fps)


def encode_masks(masks: NDArray[np.uint8], fps: int = 10) -> bytes:
    """Lossless Matroska bytes of instance ids ``[T, H, W]`` uint8.

    Raises:
        ShapeError: not uint8 ``[T, H, W]``, or no frame at all.
    """
    if masks.dtype != np.uint8 or masks.ndim != 3 or not len(masks):
        raise ShapeError(f"masks are {masks.dtype} {masks.shape}, not uint8 [T, H, W]")
    return _encode(masks, "gray", "ffv1", "gray", MASK, fps)


def decode_planes(data: bytes, start: int = 0, stop: int | None = None) -> NDArray[np.uint8]:
    """Frames `start` to `stop` of `encode_video`'s bytes, as ``[T, 3, H, W]`` uint8.

    Raises:
        DataError: the bytes are no video, or it ends before `stop`.
    """
    decoded: list[NDArray[np.uint8]] = []
    for frame in _decode(data, start, stop):
        if frame.format.name != "gbrp":
            frame = frame.reformat(format="gbrp")
        decoded.append(np.stack([_plane(frame, plane) for plane in PLANES_OF_RGB]))
    return _complete(decoded, start, stop)


def decode_video(data: bytes, start: int = 0, stop: int | None = None) -> NDArray[np.uint8]:
    """Frames `start` to `stop` of `encode_video`'s bytes, as ``[T, H, W, 3]`` uint8.

    Raises:
        DataError: the bytes are no video, or it ends before `stop`.
    """
    return np.ascontiguousarray(decode_planes(data, start, stop).transpose(0, 2, 3, 1))


def decode_masks(data: bytes) -> NDArray[np.uint8]:
    """Instance ids ``[T, H, W]`` uint8 from `encode_masks`' bytes.

    Raises:
        DataError: the bytes are no video.
    """
    return _complete([_plane(frame, 0).copy() for frame in _decode(data, 0, None)], 0, None)


def write_mp4(
    target: Path | IO[bytes], frames: NDArray[np.uint8], fps: int = 10, scale: int = 1
) -> None:
    """Write frames ``[T, H, W, 3]`` uint8 as an MP4 (H.264, yuv420p) that every browser plays.

    Args:
        target: a path, or a seekable binary file, e.g. `io.BytesIO` to embed in a page.
        frames: odd sides lose their last row or column, which yuv420p cannot hold.
        fps: frames per second.
        scale: how many times larger each pixel is drawn, unblurred.

    Raises:
        ShapeError: not uint8 ``[T, H, W, 3]``, or no frame at all.
    """
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or not len(frames):
        raise ShapeError(f"video is {frames.dtype} {frames.shape}, not uint8 [T, H, W, 3]")
    frames = frames.repeat(scale, axis=1).repeat(scale, axis=2)
    even = frames[:, : frames.shape[1] // 2 * 2, : frames.shape[2] // 2 * 2]
    data = _encode(even, "rgb24", "libx264", "yuv420p", PREVIEW, fps, container="mp4")
    if isinstance(target, Path):
        target.write_bytes(data)
    else:
        target.write(data)


def _encode(
    images: NDArray[np.uint8],
    pixels: str,
    codec: str,
    stored_pixels: str,
    options: Mapping[str, str],
    fps: int,
    container: str = "matroska",
) -> bytes:
    """Encode `images` in the pixel format `pixels` with an FFmpeg codec, in one thread."""
    buffer = io.BytesIO()
    output: Any  # PyAV's annotations leave half of their types open
    with av.open(buffer, "w", format=container, options={"fflags": "+bitexact"}) as output:
        stream = output.add_stream(codec, rate=fps)
        stream.height, stream.width = images.shape[1:3]
        stream.pix_fmt = stored_pixels
        stream.options = dict(options)
        stream.gop_size = len(images)
        stream.codec_context.flags |= Flags.bitexact
        stream.codec_context.thread_count = 1
        for image in images:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=pixels)
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return buffer.getvalue()


def _decode(data: bytes, start: int, stop: int | None) -> Iterator[av.VideoFrame]:
    """Frames in order, decoded in one thread: loaders run many of these side by side."""
    source: Any
    try:
        with av.open(io.BytesIO(data), "r", format="matroska") as source:
            if not source.streams.video:
                raise DataError("it holds no video stream")
            stream = source.streams.video[0]
            stream.codec_context.thread_count = 1
            # Report damage instead of painting over it.
            stream.codec_context.options = {"err_detect": "explode"}
            for index, frame in enumerate(source.decode(stream)):
                if stop is not None and index >= stop:
                    return
                if index >= start:
                    yield frame
    except FFmpegError as error:
        raise DataError(f"it cannot be decoded ({error.strerror})") from error


def _plane(frame: av.VideoFrame, index: int) -> NDArray[Any]:
    """One plane `[H, W]` of a frame, a view without the padding at the end of its rows."""
    plane: Any = frame.planes[index]
    pixels = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)
    return pixels[:, : plane.width]


def _complete(decoded: list[NDArray[np.uint8]], start: int, stop: int | None) -> NDArray[np.uint8]:
    if not decoded or (stop is not None and len(decoded) != stop - start):
        wanted = f"frames {start} to {stop}" if stop is not None else "a single frame"
        raise DataError(f"it ends before {wanted}: {len(decoded)} frames decoded")
    return np.stack(decoded)
