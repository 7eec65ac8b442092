"""Videos of truth, prediction and difference, side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from acwm_core.evaluation.clip_results import ClipResult
from acwm_core.metric import Metric
from acwm_core.shapes import Clip

PANEL = 256
"""Panels are drawn about this high, in whole multiples of a pixel."""

DIVIDER = 2
"""Dark columns between two panels, in pixels before magnification; even, as H.264 wants it."""

SHEET_COLUMNS = 8
"""Frames on a contact sheet."""

FULL_ERROR = 0.5
"""Largest error over channels that the difference panel tells apart."""

_HEAT_LEVELS = (0.0, 0.15, 0.4, 0.7, 1.0)
_HEAT_COLOURS = ((13, 14, 22), (58, 22, 92), (176, 44, 98), (245, 132, 60), (255, 244, 196))


def side_by_side(truth: Clip, prediction: Clip) -> NDArray[np.uint8]:
    """Truth | prediction | difference of a clip, `[T, H, W', 3]` uint8.

    Args:
        truth: `[T, 3, H, W]` in [0, 1].
        prediction: like `truth`.
    """
    return join(panels(truth, prediction))


def panels(truth: Clip, prediction: Clip) -> list[NDArray[np.uint8]]:
    """Truth, prediction and difference of a clip, each `[T, H, W, 3]` uint8."""
    true, predicted = to_pixels(truth), to_pixels(prediction)
    return [true, predicted, difference(true, predicted)]


def contact_sheet(panels: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Frames evenly spread over a clip, one row per panel, as a picture `[H', W', 3]`.

    Args:
        panels: `[T, H, W, 3]` each.
    """
    shown = sheet_frames(len(panels[0]))
    rows = [join([panel[index][None] for index in shown])[0] for panel in panels]
    divider = np.full((DIVIDER, *rows[0].shape[1:]), _HEAT_COLOURS[0], np.uint8)
    return np.concatenate([part for row in rows for part in (divider, row)][1:])


def sheet_frames(frames: int) -> list[int]:
    """Which of so many frames stand on a contact sheet."""
    return np.linspace(0, frames - 1, min(frames, SHEET_COLUMNS)).round().astype(int).tolist()


def join(panels: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Panels `[T, H, W, 3]` beside one another, with dark columns between them."""
    frames, height = panels[0].shape[:2]
    divider = np.full((frames, height, DIVIDER, 3), _HEAT_COLOURS[0], np.uint8)
    parts = [part for panel in panels for part in (divider, panel)]
    return np.concatenate(parts[1:], axis=2)


def difference(truth: NDArray[np.uint8], prediction: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The largest error over channels as heat: dark for none, bright from `FULL_ERROR` on."""
    error = np.abs(truth.astype(np.int16) - prediction).max(-1) / (255 * FULL_ERROR)
    heat = np.empty((*error.shape, 3))
    for channel, values in enumerate(zip(*_HEAT_COLOURS, strict=True)):
        heat[..., channel] = np.interp(error, _HEAT_LEVELS, values)
    return heat.round().astype(np.uint8)


def to_pixels(clip: Clip) -> NDArray[np.uint8]:
    """A clip `[T, 3, H, W]` in [0, 1] as `[T, H, W, 3]` uint8."""
    pixels = (clip.detach().cpu().clamp(0, 1) * 255).round().byte()
    return pixels.permute(0, 2, 3, 1).contiguous().numpy()


def magnification(height: int) -> int:
    """How many times larger a panel of that height is drawn."""
    return max(1, round(PANEL / height))


def pick_clips(
    results: Sequence[ClipResult], name: str, metric: Metric, count: int
) -> dict[tuple[int, int], str]:
    """The clips to show: ``best``, ``median`` and ``worst`` by the model's score, if any.

    Args:
        results: of one split.
        name: the metric's registered name.
        metric: says which way is good.
        count: how many of each; fewer where the split is small.

    Returns:
        What each clip, by episode and start, was picked for, best first.
    """
    sign = -1 if metric.higher_is_better else 1
    rows = [r for r in results if r.kind == "model" and not math.isnan(r.values[name])]
    rows.sort(key=lambda r: (sign * r.values[name], r.episode, r.start))
    ranked = [(r.episode, r.start) for r in rows]
    middle = max(0, (len(ranked) - count) // 2)
    chosen = {
        "best": ranked[:count],
        "worst": ranked[len(ranked) - count :],
        "median": ranked[middle : middle + count],
    }
    picks: dict[tuple[int, int], str] = {}
    for pick, clips in chosen.items():
        for clip in clips:
            picks.setdefault(clip, pick)
    return {clip: picks[clip] for clip in ranked if clip in picks}
