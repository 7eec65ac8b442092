"""The training curve, read from a run's ``metrics.csv``."""

from __future__ import annotations

import csv
from pathlib import Path

from acwm_core.report.figures import Line

SMOOTHED_POINTS = 40
"""About how many independent points a smoothed curve shows."""


def read_curve(file: Path, column: str) -> tuple[list[float], list[float]]:
    """Steps and values of one column, where it has a value; empty if there is no such column."""
    if not file.exists():
        return [], []
    with file.open(newline="", encoding="utf-8") as opened:
        rows = [row for row in csv.DictReader(opened) if row.get(column)]
    return [float(row["step"]) for row in rows], [float(row[column]) for row in rows]


def smooth(values: list[float]) -> list[float]:
    """Mean over a window around each value, narrower at the ends."""
    reach = len(values) // (2 * SMOOTHED_POINTS)
    smoothed: list[float] = []
    for index in range(len(values)):
        near = min(reach, index, len(values) - 1 - index)
        window = values[index - near : index + near + 1]
        smoothed.append(sum(window) / len(window))
    return smoothed


def training_lines(file: Path) -> list[Line]:
    """The training loss, raw and smoothed, and the validation loss."""
    steps, losses = read_curve(file, "train/loss")
    lines: list[Line] = []
    if len(steps) > 1:
        lines.append(Line("each batch", "model", steps, losses, faint=True))
        lines.append(Line("training", "model", steps, smooth(losses)))
    steps, losses = read_curve(file, "val/loss")
    if len(steps) > 1:
        lines.append(Line("held-out episodes", "shuffled", steps, losses))
    return lines
