"""What `acwm plan` stores in a folder of results, for those that read it; without torch."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from acwm_core.evaluation.statistics import Estimate
from acwm_core.files import read_json

PLANS = "planning"
"""Folder within a run folder, or an experiment's, with a folder of results for each task."""

PLAN_SUMMARY = "summary.json"
"""File that `acwm plan` writes after every episode into a folder of results."""

VIDEOS = "videos"
"""Folder of the videos ``ROW-SEED.mp4`` beside it, each with its curves in ``ROW-SEED.json``."""


@dataclass(frozen=True)
class RowSummary:
    """One row of a table of plans; older tables lack what has a default."""

    row: str  # who acted: one of `settings.ROW_NAMES`
    episodes: int
    successes: int
    success: Estimate  # share, with its exact interval (Clopper and Pearson 1934)
    distance: Estimate  # mean final distance, with its bootstrap interval
    start_distance: float  # mean
    seeds: list[int] = field(default_factory=list[int])  # numbers of the episodes, sorted
    failures: int = 0
    # McNemar's p against the first row, on the seeds of both; None for the first row itself
    p: float | None = None
    seconds_per_decision: float | None = None
    rollouts_per_decision: float | None = None


@dataclass(frozen=True)
class PlanTable:
    """``summary.json``, without the settings."""

    environment: str
    task: str
    rows: list[RowSummary]
    unit: str = ""  # unit of the distances
    file_sha256: str | None = None  # SHA-256 of the model's file

    @classmethod
    def read(cls, folder: Path) -> PlanTable:
        """The table in a folder of results."""
        return read_json(folder / PLAN_SUMMARY, cls, "a table of plans")

    def row(self, name: str) -> RowSummary | None:
        """The row of that name; None if there is none."""
        return next((row for row in self.rows if row.row == name), None)


@dataclass(frozen=True)
class PlannedDistances:
    """What a decision predicted: distances `[L]` at some frames `[L]` of the episode."""

    frames: list[int]
    distances: list[float | None]


@dataclass(frozen=True)
class EpisodeCurves:
    """The contents of the JSON file next to a video."""

    row: str  # who acted
    seed: int  # number of the episode
    success: bool
    failed: bool  # whether the task failed, which no later success can undo
    unit: str  # unit of the distances
    tolerance: float  # largest distance that counts as success
    fps: float
    panels: list[str]  # names of the video's panels
    distances: list[float | None]  # from the goal in every frame, from the simulator
    # the same in the model's frames, read by an estimator. None where it cannot read it; empty
    # without a model or an estimator
    imagined: list[float | None] = field(default_factory=list[float | None])
    # what each decision predicted for its whole plan; empty if `imagined` is empty
    plans: list[PlannedDistances] = field(default_factory=list[PlannedDistances])

    @property
    def widest_gap(self) -> tuple[int, float] | None:
        """The frame in which imagined and true distance differ most, and the difference."""
        gaps = [
            (frame, abs(imagined - true))
            for frame, (imagined, true) in enumerate(
                zip(self.imagined, self.distances, strict=False)
            )
            if imagined is not None and true is not None
        ]
        return max(gaps, key=lambda gap: gap[1], default=None)
