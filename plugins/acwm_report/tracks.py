"""The tracks of things that a model sees, as the page draws them over a panel of a video."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from acwm_core.evaluation.results import Tracks

GOLDEN = 0.381966
"""Step from one hue to the next, so that neighbours differ."""

FAINTEST = 0.3
"""Opacity of what hardly counts."""


@dataclass(frozen=True)
class Track:
    """One thing over a clip, in pixels of the frame."""

    name: str
    colour: str
    opacity: float
    lines: list[str]  # points of SVG polylines, one per stretch in which it is seen
    places: str  # all of them, `x,y` each


def tracks(found: Tracks, panel: str, height: int, width: int) -> list[Track]:
    """The tracks in the panel ``truth`` or ``prediction``."""
    rows = found.seen if panel == "truth" else found.predicted
    made: list[Track] = []
    for number, (name, share) in enumerate(zip(found.names, found.shares, strict=True)):
        places = [_in_pixels(row[number], height, width) for row in rows]
        stretches = groupby(places, key=lambda place: "NaN" in place)
        lines = [" ".join(stretch) for missing, stretch in stretches if not missing]
        opacity = round(FAINTEST + (1 - FAINTEST) * share, 2)
        made.append(Track(name, _colour(number), opacity, lines, " ".join(places)))
    return made


def _in_pixels(place: Sequence[float | None], height: int, width: int) -> str:
    right, down = place
    if right is None or down is None:
        return "NaN,NaN"
    return f"{right * width:.2f},{down * height:.2f}"


def _colour(number: int) -> str:
    parts = colorsys.hls_to_rgb(number * GOLDEN % 1, 0.62, 0.9)
    return "#" + "".join(f"{round(255 * part):02x}" for part in parts)
