"""Frames as pictures for people: pixels, enlarged, joined, and spread over a strip."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from acwm_core.model.shapes import Clip

Picture = NDArray[np.uint8]
"""``[H, W, 3]`` uint8; a video has a leading axis T."""

PANEL = 256
"""Approximate height of a panel in pixels; frames are magnified by a whole factor."""


def to_pixels(clip: Clip) -> Picture:
    """A clip `[T, 3, H, W]` in [0, 1] as `[T, H, W, 3]` uint8; NaN is black."""
    pixels = (clip.detach().cpu().nan_to_num().clamp(0, 1) * 255).round().byte()
    return pixels.permute(0, 2, 3, 1).contiguous().numpy()


def magnification(height: int, panel: int = PANEL) -> int:
    """The whole factor by which a picture of this height is enlarged to about `panel` pixels."""
    return max(1, round(panel / height))


def enlarge(picture: Picture, factor: int) -> Picture:
    """Enlarge pictures or videos by a whole factor, by repeating pixels."""
    return picture.repeat(factor, axis=-3).repeat(factor, axis=-2)


def join(
    pictures: Sequence[Picture], *, down: bool = False, gap: int = 0, colour: Sequence[int] = (255,)
) -> Picture:
    """Join pictures, or videos of equal length, in a row, or in a column if `down`.

    Args:
        pictures: `[…, H, W, 3]` each; smaller ones are filled up on the right or below.
        down: whether each is below the one before.
        gap: pixels between them.
        colour: of the gaps and of what is filled up.
    """
    along, across = (-3, -2) if down else (-2, -3)
    size = max(picture.shape[across] for picture in pictures)

    def blank(picture: Picture, axis: int, pixels: int) -> Picture:
        shape = [*picture.shape]
        shape[axis] = pixels
        return np.full(shape, colour, np.uint8)

    parts: list[Picture] = []
    for picture in pictures:
        rest = blank(picture, across, size - picture.shape[across])
        filled = np.concatenate([picture, rest], axis=across)
        parts += [blank(filled, along, gap), filled]
    return np.concatenate(parts[1:], axis=along)


def moments(frames: int, most: int) -> list[int]:
    """Indices of at most `most` evenly spaced frames of a video, from the first to the last."""
    return np.linspace(0, frames - 1, min(frames, most)).round().astype(int).tolist()


def strip(
    videos: Sequence[Picture], columns: int = 8, *, gap: int = 0, colour: Sequence[int] = (255,)
) -> Picture:
    """A picture of the `moments` of videos of equal length, with one row per video."""
    times = moments(len(videos[0]), columns)
    rows = [join([video[t] for t in times], gap=gap, colour=colour) for video in videos]
    return join(rows, down=True, gap=gap, colour=colour)
