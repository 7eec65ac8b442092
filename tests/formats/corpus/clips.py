"""Video files of numbered pictures, written by PyAV and Pillow."""

from dataclasses import dataclass, field
from fractions import Fraction

import av
import numpy as np
from PIL import Image

from acwm_benchmark.scheduling import scheduling_kept
from tests.formats.corpus.pictures import SIZE, depth, picture

FAST = {
    "libx264": {"preset": "ultrafast", "crf": "12", "x264-params": "log-level=none"},
    "libx264rgb": {"preset": "ultrafast", "qp": "0"},
    "libx265": {"preset": "ultrafast", "crf": "10", "x265-params": "log-level=none:pools=1"},
    "libsvtav1": {"preset": "12", "crf": "20", "svtav1-params": "lp=1"},
    "libvpx-vp9": {"deadline": "realtime", "cpu-used": "8", "crf": "15", "b": "0"},
    "mpeg4": {"qscale": "2", "b": "2000000"},
    "mjpeg": {"qscale": "2", "b": "4000000", "qmin": "1"},
}


@dataclass(frozen=True)
class Clip:
    """How frames are stored: codec, pixel format and container, and what is peculiar to the file.

    `tick` is the unit of time stamps; by default one frame. `shift` moves all stamps by so many
    frames; negative ones are cut by an edit list. `rotation` is what players turn frames by, in
    degrees counterclockwise; `aspect` is the shape of a pixel.
    """

    codec: str = "libx264"
    pixels: str = "yuv420p"
    suffix: str = "mp4"
    options: dict = field(default_factory=dict)
    tick: Fraction | None = None
    shift: int = 0
    rotation: int = 0
    aspect: Fraction | None = None


def stored(number, clip, size=SIZE):
    """The picture as a PyAV frame in the pixel format of the clip."""
    if clip.pixels.startswith("gray1"):
        return av.VideoFrame.from_ndarray(depth(number, size), format="gray16le")
    image = picture(number, size)
    if clip.rotation:
        image = np.ascontiguousarray(np.rot90(image, -clip.rotation // 90))
    if clip.aspect:  # squeezed, for players to widen
        image = image[:, :: clip.aspect.numerator]
    if clip.pixels in ("yuva420p", "argb", "bgra"):
        image = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
        return av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgba")
    return av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")


def write_clip(path, numbers, times, rate, clip, size=SIZE):
    """Write pictures of `numbers` that are shown at `times` (seconds)."""
    tick = clip.tick or 1 / Fraction(rate)
    options = {"avoid_negative_ts": "disabled"} if clip.shift < 0 else {}
    with scheduling_kept(), av.open(str(path), "w", options=options) as output:
        stream = output.add_stream(clip.codec, rate=Fraction(rate))
        first = stored(0, clip, size)
        stream.width, stream.height, stream.pix_fmt = first.width, first.height, clip.pixels
        stream.options = {**FAST.get(clip.codec, {}), **clip.options}
        stream.codec_context.time_base = tick
        stream.codec_context.thread_count = 1
        if clip.aspect:
            stream.codec_context.sample_aspect_ratio = clip.aspect
        if clip.rotation:
            stream.set_display_rotation(clip.rotation)
        ticks = [round(Fraction(time) / tick) for time in times]
        orderly = len({*ticks}) == len(ticks)  # an encoder takes no two frames of one moment
        for place, number in enumerate(numbers):
            frame = stored(number, clip, size)
            frame.pts, frame.time_base = ticks[place] if orderly else place, tick
            _mux(output, stream, frame, clip, None if orderly else ticks)
        _mux(output, stream, None, clip, None if orderly else ticks)


def _mux(output, stream, frame, clip, ticks):
    for packet in stream.encode(frame):
        if ticks is not None:
            packet.pts = packet.dts = ticks[packet.pts]
        step = round(1 / (stream.average_rate * packet.time_base))
        packet.pts += clip.shift * step
        packet.dts += clip.shift * step
        output.mux(packet)


def write_images(folder, numbers, kind, size=SIZE):
    """Write a folder of images: png, jpg, a 16-bit grey png of depth, or a png with alpha."""
    folder.mkdir(parents=True)
    for place, number in enumerate(numbers):
        image = Image.fromarray(depth(number, size) if kind == "depth" else picture(number, size))
        if kind == "alpha":
            image.putalpha(255)
        elif kind == "grey":
            image = image.convert("L")
        suffix = kind if kind in ("jpg", "webp", "bmp") else "png"
        quality = {"quality": 92} if suffix == "jpg" else {}
        image.save(folder / f"frame_{place}.{suffix}", **quality)


def write_gif(path, numbers, rate, size=SIZE):
    """Write a GIF, whose times are multiples of 10 ms."""
    images = [Image.fromarray(picture(number, size)) for number in numbers]
    images[0].save(path, save_all=True, append_images=images[1:], duration=round(1000 / rate))
