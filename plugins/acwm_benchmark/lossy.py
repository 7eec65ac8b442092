"""What a lossy video codec costs, measured on the truth.

The encoder of a participant is not known, only its file. So the quality is sought at which the
first prediction, encoded again, is as large as that file; then the truth is encoded so.
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from acwm_benchmark.videos import Coding, read_video
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
        sample: one of them.
        fps: their frames per second.

    Raises:
        DataError: acwm cannot encode so.
    """

    def __init__(self, coding: Coding, sample: Path, fps: float) -> None:
        self.coding, self.fps = coding, fps
        name = coding.codec.removeprefix("lib").partition("_")[0]
        name = {"dav1d": "av1", "vpx-vp9": "vp9", "aom-av1": "av1"}.get(name, name)
        if name != "gif" and name not in ENCODERS:
            raise DataError(
                f"{sample} is coded by {coding}, whose loss cannot be measured: submit H.264, or "
                "PNG or NPZ, which lose nothing"
            )
        self.encoder = ENCODERS.get(name)
        self.quality = self._found(sample, self.encoder) if self.encoder else 0

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
            return np.ascontiguousarray(read_video(path, self.fps).transpose(0, 3, 1, 2))

    def _encoded(self, frames: NDArray[np.uint8], quality: int) -> bytes:
        if self.encoder is None:
            return as_gif(frames, self.fps)
        name, stored = self.encoder.name, self.coding.pixels
        if name == "libx264" and stored == "gbrp":  # FFmpeg has an encoder of its own for it
            name, stored = "libx264rgb", "rgb24"
        encoding = Encoding("rgb24", stored, name, self.encoder.options(quality))
        return encode_frames(frames, frames.shape[1:3], encoding, self.fps, KEYFRAMES)

    def _found(self, sample: Path, encoder: Encoder) -> int:
        """The lowest quality at which the sample is still as large as its file."""
        frames = (read_video(sample, self.fps) * 255).round().astype(np.uint8)
        size, best, worst = sample.stat().st_size, encoder.best, encoder.worst
        while best < worst:
            middle = (best + worst + 1) // 2
            if len(self._encoded(frames, middle)) >= size:
                best = middle
            else:
                worst = middle - 1
        return best


def as_gif(frames: Sequence[NDArray[np.uint8]] | NDArray[np.uint8], fps: float) -> bytes:
    """A GIF as Pillow and imageio write it: 256 colours of its own for each frame."""
    pictures = [Image.fromarray(frame) for frame in frames]
    buffer = io.BytesIO()
    duration = round(1000 / fps)
    pictures[0].save(
        buffer, "gif", save_all=True, append_images=pictures[1:], duration=duration, loop=0
    )
    return buffer.getvalue()
