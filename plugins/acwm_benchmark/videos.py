"""One prediction from a file: MP4, MKV, WebM, AVI, GIF, NPZ, or a folder of PNG."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray
from PIL import Image, ImageSequence

from acwm_benchmark.tasks import BenchmarkWorld, read_array
from acwm_core.errors import DataError
from acwm_formats.frames import VideoFrames, opened_video
from acwm_formats.names import natural
from acwm_report.titles import counted

GIF, NPZ, PNG, VIDEO = ".gif", ".npz", ".png", "video"
CONTAINERS = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", GIF)

GIF_TICK = 0.01
"""Seconds to which GIF rounds times."""

JITTER = 0.001
"""Seconds by which other containers may round times."""

SLACK = 1e-3
"""How far floats may lie outside [0, 1], by rounding."""

UNREADABLE = (OSError, ValueError, SyntaxError, EOFError, LookupError, TypeError, struct.error)
"""What Pillow raises for a file that is no sound GIF."""

SIGNATURE = b"\x89PNG\r\n\x1a\n"

FLOATS = (np.float16, np.float32, np.float64)
DOUBLE = 8
"""Bytes of the largest number that a prediction may consist of."""


class Wanted(NamedTuple):
    """What a task asks for, which decides how much of a file is unpacked."""

    frames: int
    height: int
    width: int

    def check(self, name: str, frames: int, height: int, width: int) -> None:
        """Refuse a file of another length or size."""
        if frames != self.frames:
            short = "too short" if frames < self.frames else "too long"
            found = counted(frames, "frame")
            raise DataError(f"{name} is {short}: {found}, not {self.frames}")
        self.check_size(name, height, width)

    def check_size(self, name: str, height: int, width: int) -> None:
        """Refuse frames of another size."""
        if (height, width) != (self.height, self.width):
            wanted = f"{self.height}×{self.width}"
            raise DataError(f"{name} has frames of {height}×{width}, not {wanted}")


class Coding(NamedTuple):
    """How a video file is coded: FFmpeg's names of its codec and of its pixels."""

    codec: str
    pixels: str

    def __str__(self) -> str:
        return f"{self.codec} ({self.pixels})"


def coding_of(path: Path) -> Coding | None:
    """How a file of a prediction is coded; None for PNG and NPZ, which lose nothing."""
    if path.suffix.lower() not in CONTAINERS:
        return None
    with opened_video(path) as (_, stream):
        return Coding(stream.codec_context.name, stream.codec_context.pix_fmt)


def read_whole(path: Path, task: str, frames: int, world: BenchmarkWorld) -> NDArray[np.float32]:
    """Read a prediction, `[T, H, W, 3]` in [0, 1], and check it against its task.

    Raises:
        DataError: it is damaged, too short or too long, of another size or rate, or not finite;
            names the task.
    """
    try:
        return read_video(path, world.fps, Wanted(frames, *world.size))
    except DataError as error:
        raise DataError(f"{task}: {error}") from error


def read_video(path: Path, fps: float, wanted: Wanted) -> NDArray[np.float32]:
    """The frames of a file or folder, `[T, H, W, 3]` in [0, 1]; a video must have this rate.

    Length and size are compared with those wanted before frames are unpacked: a small file may
    claim, or hold, more than any machine.

    Raises:
        DataError: it is damaged, of another length, size or rate, or not finite.
    """
    if path.is_dir():
        return _read_pictures(path, wanted)
    if path.suffix.lower() == NPZ:
        return _read_arrays(path, wanted)
    if path.suffix.lower() == GIF:
        return _read_gif(path, fps, wanted)
    frames = VideoFrames(path)
    times = frames.times
    wanted.check(path.name, len(times), *frames.size)
    if len(times) > 1 and np.abs(np.diff(times) - 1 / fps).max() > JITTER:
        raise _other_rate(path, fps, (len(times) - 1) / max(1e-9, times[-1] - times[0]))
    pictures = list(frames.read(range(len(times))))
    return _unit(np.stack(pictures))


def _unit(pixels: NDArray[Any]) -> NDArray[np.float32]:
    """Whole numbers of 8 or 16 bits as float32 in [0, 1]."""
    return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)


def _other_rate(path: Path, fps: float, found: float) -> DataError:
    return DataError(
        f"{path.name} has {found:.3g} frames per second, not {fps:g}, or not at a constant rate"
    )


def _read_gif(path: Path, fps: float, wanted: Wanted) -> NDArray[np.float32]:
    """Read a GIF, in which frames that equal the one before are often left out."""
    pictures: list[NDArray[np.uint8]] = []
    try:
        with Image.open(path, formats=["GIF"]) as opened:
            for picture in ImageSequence.Iterator(opened):
                wanted.check_size(path.name, picture.height, picture.width)
                shown = picture.info.get("duration", 0) / 1000
                count = max(1, round(shown * fps))
                if abs(shown - count / fps) > GIF_TICK * count:
                    raise _other_rate(path, fps, 1 / max(shown, 1e-9))
                if len(pictures) + count > wanted.frames:
                    raise DataError(f"{path.name} is too long: more than {wanted.frames} frames")
                pictures += [np.asarray(picture.convert("RGB"))] * count
    except (*UNREADABLE, Image.DecompressionBombError) as error:
        raise DataError(f"{path.name} cannot be read ({error!s:.200})") from error
    wanted.check(path.name, len(pictures), *pictures[0].shape[:2])
    return _unit(np.stack(pictures))


def pictures_in(folder: Path) -> list[Path]:
    """The files of a folder of pictures, in the order of their numbers."""
    files = [path for path in folder.iterdir() if not path.name.startswith(".")]
    return sorted(files, key=lambda path: natural(path.name))


def _read_pictures(folder: Path, wanted: Wanted) -> NDArray[np.float32]:
    files = pictures_in(folder)
    wrong = [path.name for path in files if path.suffix.lower() != PNG]
    if wrong or not files:
        raise DataError(f"{folder} holds {wrong[0] if wrong else 'nothing'}, not PNG files alone")
    sizes: Sequence[tuple[int, int]] = [_size_of(path) for path in files]
    if len({*sizes}) > 1:
        raise DataError(f"the pictures in {folder.name} have several sizes")
    wanted.check(folder.name, len(files), *sizes[0])
    return np.stack([_read_picture(path) for path in files])


def _size_of(path: Path) -> tuple[int, int]:
    """Height and width of a PNG by its first bytes."""
    with path.open("rb") as file:
        start = file.read(24)
    if len(start) < 24 or not start.startswith(SIGNATURE) or start[12:16] != b"IHDR":
        raise DataError(f"{path.name} is not a PNG")
    width, height = struct.unpack(">II", start[16:])
    return height, width


def _read_picture(path: Path) -> NDArray[np.float32]:
    """A PNG of 8 or 16 bits, `[H, W, 3]` in [0, 1]; Pillow would cut 16 bits to 8."""
    try:
        container: Any
        with av.open(str(path), format="png_pipe") as container:
            frame = next(container.decode(video=0))
    except (FFmpegError, StopIteration, IndexError) as error:
        raise DataError(f"{path.name} cannot be read as PNG ({error})") from error
    if any(component.is_alpha for component in frame.format.components):
        raise DataError(f"{path.name} has opacity: write RGB")
    if max(component.bits for component in frame.format.components) > 8:
        return _unit(frame.to_ndarray(format="rgb48le"))
    return _unit(frame.to_ndarray(format="rgb24"))


def _read_arrays(path: Path, wanted: Wanted) -> NDArray[np.float32]:
    def check(shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        if len(shape) != 4 or shape[3] != 3:
            raise DataError(f"{path.name} holds an array {list(shape)}, not [T, H, W, 3]")
        wanted.check(path.name, *shape[:3])
        if dtype.type not in (np.uint8, *FLOATS):
            raise DataError(f"{path.name} holds {dtype}: give uint8, or floats in [0, 1]")

    video = read_array(path, VIDEO, check, math.prod(wanted) * 3 * DOUBLE)
    if video.dtype == np.uint8:
        return _unit(video)
    finite = np.isfinite(video).all((1, 2, 3))
    if not finite.all():
        raise DataError(f"{path.name} is not finite in frame {int(np.argmin(finite))}")
    low, high = float(video.min()), float(video.max())
    if low < -SLACK or high > 1 + SLACK:
        raise DataError(
            f"{path.name} holds floats from {low:.4g} to {high:.4g}: clip them to [0, 1], or give "
            "uint8"
        )
    return video.astype(np.float32)
