"""Writes videos that hold many episodes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.codec.context import Flags
from av.video.frame import PictureType
from numpy.typing import NDArray

from acwm_core.data.video import MP4
from acwm_core.env.card import exact_rate


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

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        self.frames = self.bytes = 0
        self._rate = rate = exact_rate(fps)
        options = {"fflags": "+bitexact"}
        self._output: Any = av.open(str(path), "w", format="mp4", options=options)
        self._stream: Any = self._output.add_stream(MP4.codec, rate=rate)
        self._stream.height, self._stream.width = size
        self._stream.pix_fmt = MP4.stored
        self._stream.options = dict(MP4.options)
        self._stream.gop_size = math.ceil(rate)
        self._stream.codec_context.flags |= Flags.bitexact
        self._stream.codec_context.thread_count = 1  # for equal bytes everywhere

    def add(self, episode: NDArray[np.uint8]) -> None:
        """Write the frames ``[T, H, W, 3]`` uint8 of one episode."""
        for index, image in enumerate(episode):
            frame: Any = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            frame.pts, frame.time_base = self.frames, 1 / self._rate
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
