"""The results table of a task: every row has episodes of the same seeds, saved as they finish."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from acwm_core.evaluation.statistics import CONFIDENCE, Estimate, with_interval, within
from acwm_core.files import writing, written_whole
from acwm_planning.results import PLAN_SUMMARY, RowSummary
from acwm_planning.resumable import Line
from acwm_planning.settings import ROW_NAMES


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


def summarise(lines: Sequence[Line], names: Sequence[str] = ROW_NAMES) -> list[RowSummary]:
    """Summarise each row that has episodes, in the order of these names."""
    by_row = {row: {n["seed"]: n for n in lines if n["row"] == row} for row in names}
    rows = [row for row in names if by_row[row]]
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
