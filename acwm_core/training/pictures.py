"""Pictures of training, and the loggers that show them."""

from __future__ import annotations

import io
from functools import singledispatch
from pathlib import Path
from typing import Any, cast

import numpy as np
from lightning.pytorch.loggers import MLFlowLogger, TensorBoardLogger, WandbLogger
from lightning.pytorch.loggers.logger import Logger
from numpy.typing import NDArray
from PIL import Image
from tensorboard.compat.proto import summary_pb2  # pyright: ignore[reportMissingTypeStubs]

from acwm_core.data.pictures import join, strip, to_pixels
from acwm_core.model.shapes import Video

STRIP_CLIPS, STRIP_FRAMES = 4, 8
"""Most clips of a strip, and frames of each."""


def encode_gif(truth: Video, predicted: Video, fps: float) -> bytes:
    """An endlessly looping GIF: one row per clip, truth on the left."""
    pairs = zip(map(to_pixels, truth), map(to_pixels, predicted), strict=True)
    frames = join([join(pair) for pair in pairs], down=True)
    first, *others = map(Image.fromarray, frames)
    buffer = io.BytesIO()
    options: dict[str, Any] = {"save_all": True, "append_images": others, "loop": 0}
    first.save(buffer, format="GIF", duration=round(1000 / fps), **options)
    return buffer.getvalue()


def draw_strip(truth: Video, predicted: Video) -> NDArray[np.uint8]:
    """A picture `[H, W, 3]` of frames from the first to the last: per clip truth, prediction below.

    It shows at most `STRIP_CLIPS` clips and `STRIP_FRAMES` frames of each.
    """
    pairs = zip(truth[:STRIP_CLIPS], predicted[:STRIP_CLIPS], strict=True)
    return strip([to_pixels(clip) for pair in pairs for clip in pair], STRIP_FRAMES)


@singledispatch
def show_gif(logger: Logger, name: str, gif: Path, step: int) -> None:
    """Show a GIF, if this logger can show any."""


@singledispatch
def show_picture(logger: Logger, name: str, picture: NDArray[np.uint8], step: int) -> None:
    """Show a picture `[H, W, 3]`, if this logger can show any."""


@show_gif.register
def _(logger: TensorBoardLogger, name: str, gif: Path, step: int) -> None:
    # The image tab plays GIFs; the writer's `add_video` would need moviepy.
    with Image.open(gif, formats=("GIF",)) as image:
        width, height = image.size
    make = cast(Any, summary_pb2).Summary  # generated code without type stubs
    encoded = gif.read_bytes()
    image = make.Image(height=height, width=width, colorspace=3, encoded_image_string=encoded)
    summary = make(value=[make.Value(tag=name, image=image)])
    cast(Any, logger).experiment.file_writer.add_summary(summary, step)


@show_picture.register
def _(logger: TensorBoardLogger, name: str, picture: np.ndarray, step: int) -> None:
    cast(Any, logger).experiment.add_image(name, picture, step, dataformats="HWC")


@show_gif.register
def _(logger: WandbLogger, name: str, gif: Path, step: int) -> None:
    logger.log_video(name, [str(gif)], step, format=["gif"])


@show_picture.register
def _(logger: WandbLogger, name: str, picture: np.ndarray, step: int) -> None:
    logger.log_image(name, [picture], step)


@show_gif.register
def _(logger: MLFlowLogger, name: str, gif: Path, step: int) -> None:
    cast(Any, logger).experiment.log_artifact(logger.run_id, str(gif), "samples")


@show_picture.register
def _(logger: MLFlowLogger, name: str, picture: np.ndarray, step: int) -> None:
    key = name.partition(":")[0]  # which becomes part of a file's name
    cast(Any, logger).experiment.log_image(logger.run_id, picture, key=key, step=step)
