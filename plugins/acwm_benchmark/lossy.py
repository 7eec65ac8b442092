"""What a lossy video codec costs, measured on the truth.

The encoder of a participant is not known, only its files. So for each the quality is sought at
which it, encoded again, is as large as the file; the truth is encoded at the median of these.
"""

from __future__ import annotations

import io
import statistics
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from acwm_benchmark.scheduling import scheduling_kept
from acwm_benchmark.videos import Coding, Wanted, read_video
from acwm_core.data.pictures import to_pixels
from acwm_core.data.video import Encoding, encode_frames
from acwm_core.errors import DataError
from acwm_core.model.shapes import Video

KEYFRAMES = 250
"""Frames from one key frame to the next, the default of FFmpeg's usual encoders."""

Options = Callable[[int], Mapping[str, str]]


def _crf(quality: int) -> Mapping[str, str]:
    return {"crf": str(quality)}


def _vp9(quality: int) -> Mapping[str, str]:
    return {"crf": str(quality), "b": "0"}


def _quantiser(quality: int) -> Mapping[str, str]:
    return {"qmin": str(quality), "qmax": str(quality)}


def _fixed(_: int) -> Mapping[str, str]:
    return {}


@dataclass(frozen=True)
class Encoder:
    """An encoder of FFmpeg with the range of its quality, best first."""

    name: str
    best: int
    worst: int
    options: Options


ENCODERS = {
    "h264": Encoder("libx264", 0, 51, _crf),
    "hevc": Encoder("libx265", 0, 51, _crf),
    "vp9": Encoder("libvpx-vp9", 0, 63, _vp9),
    "av1": Encoder("libsvtav1", 1, 63, _crf),
    "mpeg4": Encoder("mpeg4", 1, 31, _quantiser),
    "mjpeg": Encoder("mjpeg", 2, 31, _quantiser),
    **{name: Encoder(name, 0, 0, _fixed) for name in ("ffv1", "png", "rawvideo", "huffyuv")},
}
"""How to encode as a file is coded, by FFmpeg's name of the codec."""


class LossyClip(NamedTuple):
    """A file that was handed in: its size in bytes, and its frames `[T, H, W, 3]` in [0, 1]."""

    size: int
    video: NDArray[np.float32]


class Lossless:
    """Stands for files that lose nothing."""

    def __call__(self, video: Video, /) -> Video:
        """The frames as they are."""
        return video

    def fingerprint(self) -> str:
        """What it depends on: nothing."""
        return "lossless"


class LossyVideo:
    """Encodes and decodes frames as a participant's files are coded.

    Args:
        coding: how the files are coded.
        samples: all of them.
        fps: their frames per second.

    Raises:
        DataError: acwm cannot encode so.
    """

    def __init__(self, coding: Coding, samples: Iterable[LossyClip], fps: float) -> None:
        self.coding, self.fps = coding, fps
        name = coding.codec.removeprefix("lib").partition("_")[0]
        name = {"dav1d": "av1", "vpx-vp9": "vp9", "aom-av1": "av1"}.get(name, name)
        if name != "gif" and name not in ENCODERS:
            raise DataError(
                f"predictions are coded by {coding}, whose loss cannot be measured: submit H.264, "
                "or PNG or NPZ, which lose nothing"
            )
        self.encoder = ENCODERS.get(name)
        self.quality = self._median_quality(samples, self.encoder) if self.encoder else 0

    def fingerprint(self) -> str:
        """Codec, pixels and quality, e.g. ``h264 yuv420p 23``."""
        return f"{self.coding.codec} {self.coding.pixels} {self.quality}"

    def __call__(self, video: Video, /) -> Video:
        """The frames after encoding and decoding."""
        return torch.stack([torch.as_tensor(self._through(to_pixels(clip))) for clip in video])

    def _through(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        suffix = ".gif" if self.encoder is None else ".mkv"
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, f"clip{suffix}")
            path.write_bytes(self._encoded(frames, self.quality))
            wanted = Wanted(*frames.shape[:3])
            return np.ascontiguousarray(read_video(path, self.fps, wanted).transpose(0, 3, 1, 2))

    def _encoded(self, frames: NDArray[np.uint8], quality: int) -> bytes:
        if self.encoder is None:
            return as_gif(frames, self.fps)
        name, stored = self.encoder.name, self.coding.pixels
        if name == "libx264" and stored == "gbrp":  # FFmpeg has an encoder of its own for it
            name, stored = "libx264rgb", "rgb24"
        encoding = Encoding("rgb24", stored, name, self.encoder.options(quality))
        with scheduling_kept():
            return encode_frames(frames, frames.shape[1:3], encoding, self.fps, KEYFRAMES)

    def _median_quality(self, samples: Iterable[LossyClip], encoder: Encoder) -> int:
        if encoder.best == encoder.worst:
            return encoder.best
        found: list[int] = []
        for sample in samples:
            near = found[-1] if found else (encoder.best + encoder.worst) // 2
            found.append(self._quality_of(sample, encoder, near))
        return statistics.median_low(found)

    def _quality_of(self, sample: LossyClip, encoder: Encoder, near: int) -> int:
        """The lowest quality at which the sample is still as large as its file.

        The search widens from `near`, because files of one encoder are similar.
        """
        frames = (sample.video * 255).round().astype(np.uint8)

        def is_large(quality: int) -> bool:
            return len(self._encoded(frames, quality)) >= sample.size

        low, high, step = encoder.best, encoder.worst + 1, 1
        if is_large(near):
            low = near
            while low + step < high and is_large(low + step):
                low, step = low + step, 2 * step
            high = min(high, low + step)
        else:
            high = near
            while high - step > low and not is_large(high - step):
                high, step = high - step, 2 * step
            low = max(low, high - step)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if is_large(middle) else (low, middle)
        return low


def as_gif(frames: Sequence[NDArray[np.uint8]] | NDArray[np.uint8], fps: float) -> bytes:
    """A GIF as Pillow and imageio write it: 256 colours of its own for each frame."""
    pictures = [Image.fromarray(frame) for frame in frames]
    buffer = io.BytesIO()
    duration = round(1000 / fps)
    pictures[0].save(
        buffer, "gif", save_all=True, append_images=pictures[1:], duration=duration, loop=0
    )
    return buffer.getvalue()
