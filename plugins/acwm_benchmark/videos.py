"""One prediction from a file: MP4, MKV, WebM, AVI, GIF, NPZ, or a folder of PNG."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import av
import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray
from PIL import Image, ImageSequence

from acwm_benchmark.tasks import World
from acwm_core.errors import DataError
from acwm_formats.frames import VideoFrames
from acwm_formats.names import natural

GIF, NPZ, PNG, VIDEO = ".gif", ".npz", ".png", "video"
CONTAINERS = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", GIF)

UNREADABLE = (OSError, ValueError, EOFError, LookupError, BadZipFile, zlib.error)
"""What NumPy raises for a file that is no sound NPZ."""

GIF_TICK = 0.01
"""Seconds to which GIF rounds times."""

JITTER = 0.001
"""Seconds by which other containers may round times."""

SLACK = 1e-3
"""How far floats may lie outside [0, 1], by rounding."""


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
    try:
        container: Any
        with av.open(str(path)) as container:
            context = container.streams.video[0].codec_context
            return Coding(context.name, context.pix_fmt)
    except (FFmpegError, IndexError) as error:
        raise DataError(f"{path} cannot be read as a video ({error})") from error


def read_whole(path: Path, task: str, frames: int, world: World) -> NDArray[np.float32]:
    """Read a prediction, `[T, H, W, 3]` in [0, 1], and check it against its task.

    Raises:
        DataError: it is damaged, too short or too long, of another size or rate, or not finite;
            names the task.
    """
    try:
        video = read_video(path, world.fps)
    except DataError as error:
        raise DataError(f"{task}: {error}") from error
    height, width = world.size
    if len(video) != frames:
        short = "too short" if len(video) < frames else "too long"
        raise DataError(f"{task}: {path.name} is {short}: {len(video)} frames, not {frames}")
    if video.shape[1:3] != (height, width):
        found = f"{video.shape[1]}×{video.shape[2]}"
        raise DataError(f"{task}: {path.name} has frames of {found}, not {height}×{width}")
    return video


def read_video(path: Path, fps: float) -> NDArray[np.float32]:
    """The frames of a file or folder, `[T, H, W, 3]` in [0, 1]; a video must have this rate."""
    if path.is_dir():
        return _read_pictures(path)
    if path.suffix.lower() == NPZ:
        return _read_arrays(path)
    if path.suffix.lower() == GIF:
        return _read_gif(path, fps)
    frames = VideoFrames(path)
    times = frames.times
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


def _read_gif(path: Path, fps: float) -> NDArray[np.float32]:
    """Read a GIF, in which frames that equal the one before are often left out."""
    pictures: list[NDArray[np.uint8]] = []
    try:
        with Image.open(path) as opened:
            for picture in ImageSequence.Iterator(opened):
                shown = picture.info.get("duration", 0) / 1000
                count = max(1, round(shown * fps))
                if abs(shown - count / fps) > GIF_TICK * count:
                    raise _other_rate(path, fps, 1 / max(shown, 1e-9))
                pictures += [np.asarray(picture.convert("RGB"))] * count
    except (OSError, ValueError, SyntaxError) as error:
        raise DataError(f"{path.name} cannot be read ({error})") from error
    return _unit(np.stack(pictures))


def _read_pictures(folder: Path) -> NDArray[np.float32]:
    files = [path for path in folder.iterdir() if not path.name.startswith(".")]
    files.sort(key=lambda path: natural(path.name))
    wrong = [path.name for path in files if path.suffix.lower() != PNG]
    if wrong or not files:
        raise DataError(f"{folder} holds {wrong[0] if wrong else 'nothing'}, not PNG files alone")
    pictures = [_read_picture(path) for path in files]
    if len({picture.shape for picture in pictures}) > 1:
        raise DataError(f"the pictures in {folder.name} have several sizes")
    return np.stack(pictures)


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


def _read_arrays(path: Path) -> NDArray[np.float32]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            names = list(arrays)
            if names != [VIDEO]:
                raise DataError(f"{path.name} holds {', '.join(names) or 'nothing'}, not {VIDEO!r}")
            video: NDArray[Any] = arrays[VIDEO]
    except UNREADABLE as error:
        raise DataError(f"{path.name} cannot be read ({error})") from error
    if video.ndim != 4 or video.shape[3] != 3:
        raise DataError(f"{path.name} holds an array {list(video.shape)}, not [T, H, W, 3]")
    if video.dtype == np.uint8:
        return _unit(video)
    if video.dtype.kind != "f":
        raise DataError(f"{path.name} holds {video.dtype}: give uint8, or floats in [0, 1]")
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
