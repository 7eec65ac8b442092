"""The actions of a clip as small curves under its video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

COLOURS = 6
"""Number of colours that the page has for action dimensions."""


@dataclass(frozen=True)
class Trace:
    """One action dimension.

    Attributes:
        title: its name and unit.
        colour: CSS variable.
        points: of an SVG polyline in a box from (0, 0) to (1, 1), the upper bound at the top.
    """

    title: str
    colour: str
    points: str


def action_traces(rows: Sequence[Sequence[float]], action: Mapping[str, Any]) -> list[Trace]:
    """A curve per dimension, scaled by the bounds of the environment's actions.

    Args:
        rows: `[T, A]`; the last leads to no frame and is left out.
        action: the card's action: names, units, low, high.
    """
    shown = rows[:-1]
    last = max(len(rows) - 1, 1)
    traces: list[Trace] = []
    bounds = zip(action["names"], action["units"], action["low"], action["high"], strict=True)
    for index, (name, unit, low, high) in enumerate(bounds):
        heights = [(high - row[index]) / (high - low) for row in shown]
        # A step: the action holds for the whole interval between two frames.
        corners = [
            f"{(frame + end) / last:.4f},{height:.4f}"
            for frame, height in enumerate(heights)
            for end in (0, 1)
        ]
        title = name.replace("_", " ") + (f" ({unit})" if unit else "")
        traces.append(Trace(title, f"run{index % COLOURS + 1}", " ".join(corners)))
    return traces
