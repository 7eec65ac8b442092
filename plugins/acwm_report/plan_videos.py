"""Videos of plans: imagined beside real frames, and the distance of both from the goal."""

from __future__ import annotations

import base64
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from markupsafe import Markup

from acwm_core.errors import AcwmWarning, DataError
from acwm_core.files import read_json
from acwm_experiment.table import Experiment
from acwm_planning.results import VIDEOS, EpisodeCurves
from acwm_report.plans import distance_scale, plan_results
from acwm_report.run import EvaluatedRun, result_files

MOST_VIDEOS = 4
"""Most videos per task on a page."""


@dataclass(frozen=True)
class CurveDrawing:
    """Curves in a box from (0, 0) to (1, 1). The bottom of the box is distance 0.

    Attributes:
        top: the distance at the top of the box, with its unit.
        tolerance: position of the largest distance that counts as success, from the top.
        happened: true distances as points of SVG polylines, one per stretch without a gap.
        imagined: distances imagined by the model, likewise.
        plans: distances expected by the decisions, likewise.
        widest: where along the box imagined and true distance differ most; None if unknown.
    """

    top: str
    tolerance: float
    happened: list[str]
    imagined: list[str]
    plans: list[str]
    widest: float | None


@dataclass(frozen=True)
class PlanVideo:
    """A video on the page."""

    key: str  # its id on the page
    task: str
    curves: EpisodeCurves
    source: str  # the MP4 file: its path from the page, or a data URL
    apart: str = "model error"  # what the distance between the two curves is

    @property
    def outcome(self) -> str:
        """The outcome in words, e.g. ``solved after 12 actions``."""
        word = "solved" if self.curves.success else "failed" if self.curves.failed else "not solved"
        return f"{word} after {len(self.curves.distances) - 1} actions"

    @property
    def gap(self) -> str:
        """The largest distance between the curves in words; empty if it is not known."""
        widest, scale = self.curves.widest_gap, distance_scale(self.curves.unit)
        if widest is None:
            return ""
        frame, gap = widest
        return f"{self.apart} up to {scale.number(gap)} {scale.unit}, after {frame} actions"

    @property
    def drawing(self) -> CurveDrawing:
        """The curves of the video."""
        curves, scale = self.curves, distance_scale(self.curves.unit)
        own = [*curves.distances, *curves.imagined]
        planned = [value for plan in curves.plans for value in plan.distances]
        known = [value for value in [*own, *planned] if value is not None]
        top, last = max([*known, 2 * curves.tolerance, 1e-9]), max(len(curves.distances) - 1, 1)

        def points(frames: Sequence[int], values: Sequence[float | None]) -> list[str]:
            """One curve for each stretch of known values within the episode."""
            pairs = [(f, v) for f, v in zip(frames, values, strict=False) if f <= last]
            stretches = groupby(pairs, key=lambda pair: pair[1] is not None)
            return [
                " ".join(f"{f / last:.4f},{1 - (v or 0) / top:.4f}" for f, v in stretch)
                for is_known, stretch in stretches
                if is_known
            ]

        frames, widest = range(len(own)), curves.widest_gap
        plans = [points(plan.frames, plan.distances) for plan in curves.plans]
        return CurveDrawing(
            top=f"{scale.number(top)} {scale.unit}",
            tolerance=1 - curves.tolerance / top,
            happened=points(frames, curves.distances),
            imagined=points(frames, curves.imagined),
            plans=[curve for parts in plans for curve in parts],
            widest=None if widest is None else widest[0] / last,
        )


class VideoRoom:
    """Reads videos of plans with the model, as many as fit into some megabytes."""

    def __init__(self, megabytes: float) -> None:
        self._bytes = megabytes * 1e6

    def take(self, root: Path, folder: Path, task: str, key: str) -> list[PlanVideo]:
        """The first videos of a folder of results; those that do not fit are left out.

        Args:
            root: the folder that no video may leave by a link.
            folder: the results of a task, in `root`.
            task: name of the task.
            key: prefix of the videos' ids on the page.
        """
        chosen: list[PlanVideo] = []
        pattern = f"{folder.relative_to(root)}/{VIDEOS}/model-*.json"
        for path in result_files(root, pattern)[:MOST_VIDEOS]:
            curves, data = read_json(path, EpisodeCurves, "curves of a video"), _video(path)
            if data and len(data) <= self._bytes:
                self._bytes -= len(data)
                source = Markup("data:video/mp4;base64," + base64.b64encode(data).decode())
                chosen.append(PlanVideo(f"{key}-{len(chosen)}", task, curves, source))
        return chosen


def linked_videos(folder: Path, row: str, task: str, apart: str = "model error") -> list[PlanVideo]:
    """The videos of one way to act, for a page in the folder of results that links to them."""
    videos: list[PlanVideo] = []
    for path in sorted((folder / VIDEOS).glob(f"{row}-*.json")):
        source = f"{VIDEOS}/{path.stem}.mp4"
        try:
            curves = read_json(path, EpisodeCurves, "curves of a video")
        except DataError as error:
            warnings.warn(f"{error}: its video is not shown", AcwmWarning, stacklevel=2)
        else:
            videos.append(PlanVideo(path.stem, task, curves, source, apart))
    return videos


def plan_videos(runs: Sequence[EvaluatedRun], room: VideoRoom) -> list[list[PlanVideo]]:
    """Videos of plans with the model, per run."""
    return [
        [
            video
            for number, (folder, table) in enumerate(plan_results(run).items())
            for video in room.take(run.folder, folder, table.task, f"{run.key}-plan{number}")
        ]
        for run in runs
    ]


def task_videos(
    experiment: Experiment | None, shown: Sequence[EvaluatedRun], room: VideoRoom
) -> list[tuple[str, list[PlanVideo]]]:
    """Videos of the model by task, without those that are `shown` with their runs."""
    sections: list[tuple[str, list[PlanVideo]]] = []
    parents = [run.folder.resolve() for run in shown]
    for number, plan in enumerate(experiment.plans if experiment else ()):
        inside = any(plan.folder.resolve().is_relative_to(parent) for parent in parents)
        if not inside and plan.progress():
            videos = room.take(plan.folder, plan.folder, plan.task, f"task{number}")
            sections.append((plan.title, videos))
    return [(title, videos) for title, videos in sections if videos]


def _video(path: Path) -> bytes:
    """The bytes of the video beside its curves; empty if the file is missing or empty."""
    video = path.with_suffix(".mp4")
    return video.read_bytes() if video.is_file() else b""
