"""Size, time and loss of the formats in which a dataset could store its frames.

    python benchmarks/formats.py
    python benchmarks/formats.py --environment reacher --size 64 --episodes 1

Simulates episodes, stores each in every format with one thread, reads all frames back in order, and
then clips of 37 frames from random positions. PSNR is computed from the squared error of all
pixels; `exact` means that no pixel differs. Decoding produces planar RGB arrays, as needed for
training.
"""

from __future__ import annotations

import io
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import av
import click
import numpy as np
from av.video.reformatter import VideoReformatter
from numpy.typing import NDArray
from PIL import Image

from acwm_core.data.simulate import make_environment, simulate
from acwm_core.data.video import (
    KEYFRAMES,
    PLANES_OF_RGB,
    REPEATABLE,
    VIDEO,
    Encoding,
    encode_frames,
    plane_of,
)
from acwm_core.env.episode import EpisodeSpec

ENVIRONMENTS = ["push_cube", "push_sand", "pour_water"]
FRAMES = 37
CLIPS = 8
"""Number of clips that are read from each episode."""

Video = NDArray[np.uint8]


@dataclass(frozen=True)
class Format:
    """A way to store an episode: `pack` it, and `unpack` frames start to stop, `[T, 3, H, W]`."""

    name: str
    pack: Callable[[Video, int], Any]
    size: Callable[[Any], int]
    unpack: Callable[[Any, int, int], Video]


def film(name: str, encoding: Encoding, keyframes: int = KEYFRAMES) -> Format:
    """A video stream in Matroska, with a key frame every `keyframes` frames."""

    def pack(video: Video, fps: int) -> bytes:
        return encode_frames(video, (video.shape[1], video.shape[2]), encoding, fps, keyframes)

    return Format(name, pack, len, read_film)


def read_film(data: bytes, start: int, stop: int) -> Video:
    """Frames `start` to `stop`, decoded from the last key frame before them."""
    source: Any
    frames: list[Video] = []
    reformatter = VideoReformatter()  # shared, as its setup takes longer than a frame
    with av.open(io.BytesIO(data), "r", format="matroska") as source:
        stream = source.streams.video[0]
        stream.codec_context.thread_count = 1
        if start:
            place = start / float(stream.average_rate) / float(stream.time_base)
            source.seek(round(place), stream=stream)
        for frame in source.decode(stream):
            index = round(frame.pts * float(stream.time_base) * float(stream.average_rate))
            if index >= stop:
                break
            if index >= start:
                if frame.format.name == "gbrp":
                    frames.append(np.stack([plane_of(frame, index) for index in PLANES_OF_RGB]))
                else:
                    image = reformatter.reformat(frame, format="rgb24").to_ndarray()
                    frames.append(np.ascontiguousarray(image.transpose(2, 0, 1)))
    return np.stack(frames)


def pictures(name: str, kind: str, **options: Any) -> Format:
    """Each frame as a separate picture, written and read by Pillow."""

    def pack(video: Video, fps: int) -> list[bytes]:
        files: list[bytes] = []
        for frame in video:
            buffer = io.BytesIO()
            Image.fromarray(frame).save(buffer, kind, **options)
            files.append(buffer.getvalue())
        return files

    def size(files: Sequence[bytes]) -> int:
        return sum(map(len, files))

    def unpack(files: Sequence[bytes], start: int, stop: int) -> Video:
        opened = [np.asarray(Image.open(io.BytesIO(file))) for file in files[start:stop]]
        return np.ascontiguousarray(np.stack(opened).transpose(0, 3, 1, 2))

    return Format(name, pack, size, unpack)


def formats() -> list[Format]:
    """The formats to compare."""
    lossless = dict(VIDEO.options)
    yuv = Encoding("rgb24", "yuv444p", "libx264", lossless)
    fine = {"crf": "18", "preset": "medium", **REPEATABLE}
    return [
        film("H.264 lossless RGB (ours)", VIDEO),
        film("the same, one key frame", VIDEO, keyframes=10**6),
        film("the same, arithmetic coding", _but(VIDEO, coder="1")),
        film("H.264 lossless YUV 4:4:4", yuv),
        film("FFV1 RGB", Encoding("rgb24", "bgr0", "ffv1", {"level": "3", "coder": "1"})),
        film("H.264 crf 18, YUV 4:4:4", Encoding("rgb24", "yuv444p", "libx264", fine)),
        film("H.264 crf 18, YUV 4:2:0", Encoding("rgb24", "yuv420p", "libx264", fine)),
        pictures("PNG", "png"),
        pictures("JPEG 95, 4:4:4", "jpeg", quality=95, subsampling=0),
        pictures("JPEG 90, 4:2:0", "jpeg", quality=90, subsampling=2),
    ]


def _but(encoding: Encoding, **options: str) -> Encoding:
    return replace(encoding, options={**encoding.options, **options})


@dataclass
class Row:
    """Sums over episodes: bytes, seconds, frames read, squared error."""

    frames: int = 0
    size: int = 0
    encode: float = 0.0
    decode: float = 0.0
    clip: float = 0.0
    clip_frames: int = 0
    error: float = 0.0
    values: int = 0

    def cells(self) -> list[str]:
        """The cells of the table after the name."""
        mean = self.error / self.values
        return [
            f"{self.size / self.frames:,.0f}",
            f"{1e3 * self.encode / self.frames:.2f}",
            f"{1e3 * self.decode / self.frames:.3f}",
            f"{1e3 * self.clip / self.clip_frames:.3f}",
            f"{10 * math.log10(255**2 / mean):.1f}" if mean else "exact",
        ]


def measure(format: Format, videos: Sequence[Video], fps: int) -> Row:
    """Encode, decode and sample every video once."""
    row = Row()
    rng = np.random.default_rng(0)
    format.unpack(format.pack(videos[0], fps), 0, 1)  # loads the codec
    for video in videos:
        length = len(video)
        started = time.perf_counter()
        data = format.pack(video, fps)
        packed = time.perf_counter()
        read = format.unpack(data, 0, length)
        row.decode += time.perf_counter() - packed
        row.encode += packed - started
        row.error += float(((read.astype(np.float64) - video.transpose(0, 3, 1, 2)) ** 2).sum())
        row.values += video.size
        row.frames += length
        row.size += format.size(data)
        for first in rng.integers(0, max(1, length - FRAMES + 1), CLIPS).tolist():
            started = time.perf_counter()
            clip = format.unpack(data, first, min(first + FRAMES, length))
            row.clip += time.perf_counter() - started
            row.clip_frames += len(clip)
    return row


def simulated(name: str, size: int, episodes: int) -> tuple[list[Video], int]:
    """Videos of the first episodes of `train` and their frame rate."""
    environment = make_environment(name, {"size": size})
    videos = [simulate(environment, EpisodeSpec(name, index=i)).video for i in range(episodes)]
    environment.close()
    return videos, environment.card.fps


def shared(figures: Sequence[str]) -> str:
    """The figures of all environments, or a single one if they are equal."""
    return figures[0] if len(set(figures)) == 1 else " / ".join(figures)


@click.command(help=(__doc__ or "").partition("\n")[0])
@click.option("--environment", "names", multiple=True, default=ENVIRONMENTS, show_default=True)
@click.option("--size", "sizes", type=int, multiple=True, default=[64, 240], show_default=True)
@click.option("--episodes", default=4, show_default=True)
def main(names: Sequence[str], sizes: Sequence[int], episodes: int) -> None:
    """Print a table per size, with a figure per environment in each cell."""
    for size in sizes:
        simulations = [simulated(name, size, episodes) for name in names]
        shapes = ["×".join(map(str, videos[0].shape[1:3])) for videos, _ in simulations]
        titles = [f"{name} {shape}" for name, shape in zip(names, shapes, strict=True)]
        click.echo(f"\n{' / '.join(titles)}\n")
        click.echo("| Format | bytes/frame | encode ms | decode ms | clip ms | PSNR dB |")
        click.echo("| --- | ---: | ---: | ---: | ---: | ---: |")
        for format in formats():
            rows = [measure(format, videos, fps).cells() for videos, fps in simulations]
            cells = [shared(each) for each in zip(*rows, strict=True)]
            click.echo(f"| {' | '.join([format.name, *cells])} |")


if __name__ == "__main__":
    main()
