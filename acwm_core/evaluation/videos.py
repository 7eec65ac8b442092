"""Videos of truth, prediction and difference, side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from acwm_core.shapes import Clip

PANEL = 256
"""Panels are drawn about this high, in whole multiples of a pixel."""

DIVIDER = 2
"""Dark columns between two panels, in pixels before magnification; even, as H.264 wants it."""

FULL_ERROR = 0.5
"""Largest error over channels that the difference panel tells apart."""

TINT = (0, 168, 150)
"""Colour of the truth over the prediction."""

REPORT_PANEL = 128
"""Panels of videos in reports are encoded about this high; the page enlarges them unblurred."""

_HEAT_LEVELS = (0.0, 0.15, 0.4, 0.7, 1.0)
_HEAT_COLOURS = ((13, 14, 22), (58, 22, 92), (176, 44, 98), (245, 132, 60), (255, 244, 196))


def case_study(
    truth: Clip, prediction: Clip, masks: NDArray[np.uint8]
) -> tuple[list[list[str]], NDArray[np.uint8]]:
    """The video of a case study, with the names of its panels, row by row.

    Truth, prediction and difference stand beside one another. Where true masks `[T, H, W]` are
    known, which so are not all zero, a fourth panel has those of moving instances over the
    prediction, and the panels stand two by two.
    """
    true, predicted, error = panels(truth, prediction)
    if not masks.any():
        return [["truth", "prediction", "difference"]], join([true, predicted, error])
    rows = [join([true, predicted]), join([error, tinted(predicted, moving_instances(masks))])]
    return [["truth", "prediction"], ["difference", "truth over prediction"]], join(rows, axis=1)


def moving_instances(masks: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Where an instance is that moves during the clip, `[T, H, W]`; never the background.

    One that stands still and is covered by others at times sweeps no more than its own area.
    """
    moving = np.zeros(masks.shape, np.bool_)
    for instance in np.unique(masks[masks > 0]):
        here = masks == instance
        if here.any(0).sum() > 1.1 * here.sum((1, 2)).max():  # all it covers, and in a frame
            moving |= here
    return moving


def tinted(picture: NDArray[np.uint8], where: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Frames `[T, H, W, 3]` in grey, with a tint over `where` that is darkest at its edges."""
    grey = np.repeat(picture.mean(-1, keepdims=True), 3, axis=-1)
    padded = np.pad(where, ((0, 0), (1, 1), (1, 1)), mode="edge")
    inner = padded[:, :-2, 1:-1] & padded[:, 2:, 1:-1] & padded[:, 1:-1, :-2] & padded[:, 1:-1, 2:]
    strength = np.where(where & ~inner, 0.85, np.where(where, 0.35, 0.0))[..., None]
    return (grey * (1 - strength) + np.array(TINT) * strength).round().astype(np.uint8)


def panels(truth: Clip, prediction: Clip) -> list[NDArray[np.uint8]]:
    """Truth, prediction and difference of a clip, each `[T, H, W, 3]` uint8.

    The difference is the largest one over channels as heat: dark for none, bright from `FULL_ERROR`
    on.
    """
    true, predicted = to_pixels(truth), to_pixels(prediction)
    error = np.abs(true.astype(np.int16) - predicted).max(-1) / (255 * FULL_ERROR)
    heat = np.empty(true.shape)
    for channel, values in enumerate(zip(*_HEAT_COLOURS, strict=True)):
        heat[..., channel] = np.interp(error, _HEAT_LEVELS, values)
    return [true, predicted, heat.round().astype(np.uint8)]


def join(panels: Sequence[NDArray[np.uint8]], axis: int = 2) -> NDArray[np.uint8]:
    """Panels `[T, H, W, 3]`, or pictures along another axis, with dark lines between them."""
    shape = [*panels[0].shape]
    shape[axis] = DIVIDER
    divider = np.full(shape, _HEAT_COLOURS[0], np.uint8)
    parts = [part for panel in panels for part in (divider, panel)]
    return np.concatenate(parts[1:], axis)


def to_pixels(clip: Clip) -> NDArray[np.uint8]:
    """A clip `[T, 3, H, W]` in [0, 1] as `[T, H, W, 3]` uint8; NaN is black."""
    pixels = (clip.detach().cpu().nan_to_num().clamp(0, 1) * 255).round().byte()
    return pixels.permute(0, 2, 3, 1).contiguous().numpy()


def magnification(height: int, panel: int = PANEL) -> int:
    """How many times larger a picture of that height is drawn, for panels of about `panel`."""
    return max(1, round(panel / height))
