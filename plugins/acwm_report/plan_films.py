"""Films of plans on a page: imagined beside happened, and how far both are from the goal."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path

from markupsafe import Markup

from acwm_core.untrusted import read_bytes, read_json
from acwm_report.plans import distance_scale, planned
from acwm_report.run import EvaluatedRun, result_files

FILMS = "films"
"""The films of a task are ``RUN/planning/TASK/films/model-*.mp4``, each beside a file of curves."""

MOST_FILMS, MOST_BYTES = 4, 8_000_000
"""Films of a task on a page, and the size of one at most."""


@dataclass(frozen=True)
class PlannedDistances:
    """What a decision expected at some frames of the episode."""

    frames: list[int]
    distances: list[float | None]


@dataclass(frozen=True)
class PlanFilm:
    """The file beside a film: distances from the goal, frame by frame."""

    row: str  # who acted
    seed: int  # number of the episode
    success: bool
    failed: bool
    unit: str  # of distances
    tolerance: float  # largest distance that counts as success
    fps: float
    panels: list[str]
    distances: list[float | None]  # as the simulator says
    imagined: list[float | None] = field(default_factory=list[float | None])  # by the model
    plans: list[PlannedDistances] = field(default_factory=list[PlannedDistances])

    @property
    def widest_gap(self) -> tuple[int, float] | None:
        """The frame in which imagined and true distance differ most, and by how much."""
        gaps = [
            (frame, abs(seen - true))
            for frame, (seen, true) in enumerate(zip(self.imagined, self.distances, strict=False))
            if seen is not None and true is not None
        ]
        return max(gaps, key=lambda each: each[1], default=None)


@dataclass(frozen=True)
class Drawing:
    """Curves in a box from (0, 0) to (1, 1), nothing at its bottom.

    Attributes:
        top: what the top of the box means, with its unit.
        tolerance: height of the largest distance that counts as success, from the top.
        happened: points of SVG polylines, as all that follow.
        imagined: one per stretch without a gap.
        plans: one per decision.
        widest: where along the box imagined and true distance differ most, if that is known.
    """

    top: str
    tolerance: float
    happened: list[str]
    imagined: list[str]
    plans: list[str]
    widest: float | None


@dataclass(frozen=True)
class EmbeddedFilm:
    """A film on the page."""

    key: str  # its id on the page
    task: str
    film: PlanFilm
    data: bytes  # the MP4 file

    @property
    def base64(self) -> Markup:
        """The file as text."""
        return Markup(base64.b64encode(self.data).decode())

    @property
    def outcome(self) -> str:
        """``solved after 12 actions``."""
        word = "solved" if self.film.success else "failed" if self.film.failed else "not solved"
        return f"{word} after {len(self.film.distances) - 1} actions"

    @property
    def gap(self) -> str:
        """Where the model was wrong most, in words; empty where that is not known."""
        found, scale = self.film.widest_gap, distance_scale(self.film.unit)
        if found is None:
            return ""
        frame, gap = found
        return f"wrong by up to {scale.number(gap)} {scale.unit}, after {frame} actions"

    @property
    def drawing(self) -> Drawing:
        """Its curves."""
        film, scale = self.film, distance_scale(self.film.unit)
        own = [*film.distances, *film.imagined]
        planned = [value for plan in film.plans for value in plan.distances]
        known = [value for value in [*own, *planned] if value is not None]
        top, last = max([*known, 2 * film.tolerance, 1e-9]), max(len(film.distances) - 1, 1)

        def points(frames: Sequence[int], values: Sequence[float | None]) -> list[str]:
            """A curve for each stretch of known values within the episode."""
            pairs = [(f, v) for f, v in zip(frames, values, strict=False) if f <= last]
            stretches = groupby(pairs, key=lambda pair: pair[1] is not None)
            return [
                " ".join(f"{f / last:.4f},{1 - (v or 0) / top:.4f}" for f, v in each)
                for there, each in stretches
                if there
            ]

        frames, widest = range(len(own)), film.widest_gap
        plans = [points(each.frames, each.distances) for each in film.plans]
        return Drawing(
            top=f"{scale.number(top)} {scale.unit}",
            tolerance=1 - film.tolerance / top,
            happened=points(frames, film.distances),
            imagined=points(frames, film.imagined),
            plans=[each for curves in plans for each in curves],
            widest=None if widest is None else widest[0] / last,
        )


def plan_films(runs: Sequence[EvaluatedRun], megabytes: float) -> list[list[EmbeddedFilm]]:
    """Films of plans with the model, per run; what finds no room is left out.

    Args:
        runs: those of the page.
        megabytes: of video at most.

    Raises:
        DataError: a film's file is damaged.
    """
    room, films = megabytes * 1e6, list[list[EmbeddedFilm]]()
    for run in runs:
        chosen: list[EmbeddedFilm] = []
        for folder, table in planned(run).items():
            pattern = f"{folder.relative_to(run.folder)}/{FILMS}/model-*.json"
            for path in result_files(run.folder, pattern)[:MOST_FILMS]:
                film, data = read_json(path, PlanFilm, "curves of a film"), _video(path)
                if data and len(data) <= room:
                    room -= len(data)
                    key = f"{run.key}-plan-{len(chosen)}"
                    chosen.append(EmbeddedFilm(key, table.task, film, data))
        films.append(chosen)
    return films


def _video(path: Path) -> bytes:
    """The film beside its curves; nothing if there is none, or a damaged one."""
    video = path.with_suffix(".mp4")
    return read_bytes(video, MOST_BYTES) if video.is_file() else b""
