"""Videos of truth, prediction and difference, side by side, and which clips are shown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.pictures import Picture, join, to_pixels
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.results import DIVIDER, Score, VideoRecord
from acwm_core.evaluation.statistics import finite
from acwm_core.model.shapes import Clip

ClipVideo = tuple[VideoRecord, NDArray[np.uint8]]
"""A record and its frames `[T, H, W, 3]`."""

FULL_ERROR = 0.5
"""Error (maximum over channels, values in [0, 1]) at which the difference panel saturates."""

TINT = (0, 168, 150)
"""Colour of the truth over the prediction."""

REPORT_PANEL = 128
"""Approximate panel height of videos in reports; the page enlarges them without blur."""

DARK = (13, 14, 22)
"""Colour of the lines between panels, and of no error."""

_HEAT_LEVELS = (0.0, 0.15, 0.4, 0.7, 1.0)
_HEAT_COLOURS = (DARK, (58, 22, 92), (176, 44, 98), (245, 132, 60), (255, 244, 196))


def video_of(
    prediction: Prediction,
    file: str,
    *,
    kind: str,
    pick: str,
    actions: NDArray[np.float32],
    values: Mapping[str, float] | None = None,
) -> ClipVideo:
    """The video of a prediction and its record, see `VideoRecord`."""
    panels, frames = case_study(
        prediction.target,
        prediction.video,
        prediction.masks,
        stacked=bool(prediction.card.views),
    )
    clip = prediction.clip
    return VideoRecord(
        file=file,
        split=clip.split,
        episode=clip.episode,
        start=clip.start,
        ood_label=prediction.ood_label,
        pick=pick,
        kind=kind,
        values={name: finite(value) for name, value in (values or {}).items()},
        actions=actions.tolist(),
        panels=panels,
    ), frames


def pick_clips(
    scores: Sequence[Score], metric: str, higher_is_better: bool, count: int
) -> dict[tuple[int, int], str]:
    """The clips to show, best first: ``best``, ``median`` or ``worst`` by episode and start.

    Takes `count` of each, or fewer in a small split, ranked by the model's score in `metric`.
    """
    sign = -1 if higher_is_better else 1
    rows = [s for s in scores if s.kind == "model" and not math.isnan(s.values[metric])]
    rows.sort(key=lambda s: (sign * s.values[metric], s.episode, s.start))
    ranked = [(s.episode, s.start) for s in rows]
    middle = max(0, (len(ranked) - count) // 2)
    picks = dict.fromkeys(ranked[middle : middle + count], "median")
    picks |= dict.fromkeys(ranked[len(ranked) - count :], "worst")
    picks |= dict.fromkeys(ranked[:count], "best")
    return {place: picks[place] for place in ranked if place in picks}


def case_study(
    truth: Clip, prediction: Clip, masks: NDArray[np.uint8], *, stacked: bool = False
) -> tuple[list[list[str]], NDArray[np.uint8]]:
    """The video of a case study, with the names of its panels, row by row.

    Truth, prediction and difference stand side by side. If true masks `[T, H, W]` are known (not
    all zero), a fourth panel shows the masks of moving instances over the prediction, and the
    panels form a 2×2 grid. If `stacked`, all are one below the other, because each is wide.
    """
    names, pictures = ["truth", "prediction", "difference"], panels(truth, prediction)
    if masks.any():
        names.append("truth over prediction")
        pictures.append(tinted(pictures[1], moving_instances(masks)))
    across = 1 if stacked else 2 if masks.any() else 3
    firsts = range(0, len(pictures), across)
    rows = [join_panels(pictures[first : first + across]) for first in firsts]
    return [names[first : first + across] for first in firsts], join_panels(rows, down=True)


def moving_instances(masks: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Masks of the instances that move during the clip, `[T, H, W]`; never the background.

    An instance moves if it sweeps clearly more than its largest area in one frame. One that stands
    still and is sometimes covered by others does not.
    """
    moving = np.zeros(masks.shape, np.bool_)
    for instance in np.unique(masks[masks > 0]):
        here = masks == instance
        if here.any(0).sum() > 1.1 * here.sum((1, 2)).max():  # area of all frames, of one frame
            moving |= here
    return moving


def tinted(picture: NDArray[np.uint8], where: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Frames `[T, H, W, 3]` in grey, with a tint over `where` that is strongest at its edges."""
    grey = np.repeat(picture.mean(-1, keepdims=True), 3, axis=-1)
    padded = np.pad(where, ((0, 0), (1, 1), (1, 1)), mode="edge")
    inner = padded[:, :-2, 1:-1] & padded[:, 2:, 1:-1] & padded[:, 1:-1, :-2] & padded[:, 1:-1, 2:]
    strength = np.where(where & ~inner, 0.85, np.where(where, 0.35, 0.0))[..., None]
    return (grey * (1 - strength) + np.array(TINT) * strength).round().astype(np.uint8)


def panels(truth: Clip, prediction: Clip) -> list[NDArray[np.uint8]]:
    """Truth, prediction and difference of a clip, each `[T, H, W, 3]` uint8.

    The difference is a heat map of the maximum over channels: dark for none, brightest from
    `FULL_ERROR` on.
    """
    true, predicted = to_pixels(truth), to_pixels(prediction)
    error = np.abs(true.astype(np.int16) - predicted).max(-1) / (255 * FULL_ERROR)
    heat = np.empty(true.shape)
    for channel, values in enumerate(zip(*_HEAT_COLOURS, strict=True)):
        heat[..., channel] = np.interp(error, _HEAT_LEVELS, values)
    return [true, predicted, heat.round().astype(np.uint8)]


def join_panels(panels: Sequence[Picture], *, down: bool = False) -> Picture:
    """Join panels, in a row or in a column, with dark lines between them."""
    return join(panels, down=down, gap=DIVIDER, colour=DARK)
