"""The results table of a task: every row has episodes of the same seeds, saved as they finish."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from acwm_core.evaluation.statistics import CONFIDENCE, Estimate, with_interval, within
from acwm_core.files import writing, written_whole
from acwm_planning.jobs import PLAN_SUMMARY
from acwm_planning.resumable import Line
from acwm_planning.settings import ROW_NAMES

VIDEOS = "videos"
"""Folder of a table's videos, beside `PLAN_SUMMARY` and the files of `ResumableResults`."""


def write_summary(folder: Path, summary: Mapping[str, Any]) -> Path:
    """Write the table."""
    path = folder / PLAN_SUMMARY
    with writing(path), written_whole(path) as partial:
        partial.write_text(json.dumps(summary, indent=1), encoding="utf-8")
    return path


@dataclass(frozen=True)
class EpisodeLine:
    """A finished episode, as `acwm plan` writes it."""

    row: str
    seed: int
    success: bool
    failed: bool
    steps: int
    start_distance: float
    distance: float
    seconds_per_decision: float | None = None
    rollouts_per_decision: float | None = None


HEADS = ("", "success", "95 %", "p", "final distance", "s / decision", "rollouts / decision")
"""Heads of the columns in which a table is shown."""


@dataclass(frozen=True)
class RowSummary:
    """One row of the table."""

    row: str
    seeds: list[int]  # numbers of the episodes, sorted
    episodes: int
    successes: int
    success: Estimate  # share, with its exact interval (Clopper and Pearson 1934)
    failures: int
    distance: Estimate  # mean final distance, with its bootstrap interval
    start_distance: float  # mean
    # McNemar's p against the first row, on the seeds of both; None for the first row itself
    p: float | None
    seconds_per_decision: float | None
    rollouts_per_decision: float | None

    def cells(self) -> tuple[str, ...]:
        """The row as text, under `HEADS`."""
        low, high = 100 * (self.success.low or 0), 100 * (self.success.high or 0)
        return (
            self.row,
            f"{self.successes}/{self.episodes}",
            f"{low:.0f} to {high:.0f} %",
            "" if self.p is None else f"{self.p:.2g}",
            f"{self.distance.value:.3g} of {self.start_distance:.3g}",
            "" if self.seconds_per_decision is None else f"{self.seconds_per_decision:.2g}",
            "" if self.rollouts_per_decision is None else f"{self.rollouts_per_decision:.0f}",
        )


def summarise(lines: Sequence[Line]) -> list[RowSummary]:
    """Summarise each row that has episodes, in the order of `ROW_NAMES`."""
    by_row = {row: {n["seed"]: n for n in lines if n["row"] == row} for row in ROW_NAMES}
    rows = [row for row in ROW_NAMES if by_row[row]]
    return [_row(row, by_row[row], by_row[rows[0]]) for row in rows]


def _row(row: str, by_seed: Mapping[int, Line], first: Mapping[int, Line]) -> RowSummary:
    lines = list(by_seed.values())
    successes = sum(bool(line["success"]) for line in lines)
    interval = binomtest(successes, len(lines)).proportion_ci(CONFIDENCE, "exact")
    distances = np.array([line["distance"] for line in lines], float)

    def mean(name: str) -> float | None:
        values = [line[name] for line in lines if name in line]
        return float(np.mean(values)) if values else None

    return RowSummary(
        row=row,
        seeds=sorted(by_seed),
        episodes=len(lines),
        successes=successes,
        success=Estimate(successes / len(lines), float(interval.low), float(interval.high)),
        failures=sum(bool(line["failed"]) for line in lines),
        distance=within(with_interval(float(distances.mean()), [distances]), (0.0, math.inf)),
        start_distance=float(np.mean([line["start_distance"] for line in lines])),
        p=None if by_seed is first else mcnemar(first, by_seed),
        seconds_per_decision=mean("seconds_per_decision"),
        rollouts_per_decision=mean("rollouts_per_decision"),
    )


def mcnemar(one: Mapping[int, Line], other: Mapping[int, Line]) -> float:
    """Two-sided p-value of McNemar's exact test for the successes on the seeds of both."""
    pairs = [(bool(one[n]["success"]), bool(other[n]["success"])) for n in one if n in other]
    better, worse = pairs.count((True, False)), pairs.count((False, True))
    return float(binomtest(better, better + worse).pvalue) if better + worse else 1.0


def missing_episodes(
    rows: Sequence[str], seeds: Sequence[int], lines: Sequence[Line]
) -> Iterator[tuple[str, int]]:
    """Episodes still to be played, seed by seed, so that a partial table compares all rows."""
    finished = {(line["row"], line["seed"]) for line in lines}
    for seed in seeds:
        yield from ((row, seed) for row in rows if (row, seed) not in finished)
