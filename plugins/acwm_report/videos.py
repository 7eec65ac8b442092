"""The videos of a report: which ones are embedded, and the curves of their actions."""

from __future__ import annotations

import base64
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from markupsafe import Markup

from acwm_core.errors import DataError
from acwm_core.evaluation.results import FOLDER, VIDEOS, VideoRecord
from acwm_core.evaluation.storage import result_file
from acwm_report.run import EvaluatedRun

MEGABYTES = 16
"""Default limit for embedded videos in megabytes, before base64 adds a third."""

BRANCH = "branch:"
"""Prefix of the kind of a video that shows other actions from the same first frame."""


@dataclass(frozen=True)
class EmbeddedVideo:
    """A video on the page."""

    key: str  # its id on the page
    record: VideoRecord  # what it shows
    data: bytes  # the MP4 file

    @property
    def base64(self) -> Markup:
        """The MP4 file as base64 text."""
        return Markup(base64.b64encode(self.data).decode())

    @property
    def branch(self) -> str:
        """The kind of other actions that it shows; ``""`` for none."""
        return self.record.kind.partition(BRANCH)[2]


def embed_videos(runs: Sequence[EvaluatedRun], megabytes: float) -> list[list[EmbeddedVideo]]:
    """Choose the videos to embed, per run.

    Videos are taken by priority, then by run: median clips before worst and best clips, before
    clips with other actions. A video that does not fit into the remaining space is skipped.
    The result is in page order: best, median and worst, then the median with other actions.

    Raises:
        DataError: a video is missing.
    """
    room = megabytes * 1e6
    candidates: list[tuple[int, int, int]] = []
    for number, run in enumerate(runs):
        for index, record in enumerate(run.summary.videos):
            rank = ("median", "worst", "best").index(record.pick) if record.kind == "model" else 3
            candidates.append((rank + record.kind.startswith(BRANCH), number, index))
    chosen: list[list[EmbeddedVideo]] = [[] for _ in runs]
    for _, number, index in sorted(candidates):
        run, record = runs[number], runs[number].summary.videos[index]
        path = result_file(run.folder / FOLDER, f"{VIDEOS}/{record.file}")
        if not path.is_file():
            evaluate = shlex.join(["acwm", "evaluate", str(run.folder)])
            raise DataError(f"the video {path} is missing: run `{evaluate}` again")
        if path.stat().st_size <= room:
            room -= path.stat().st_size
            key = f"{run.key}-{path.stem}".replace(":", "-").replace(" ", "-")
            chosen[number].append(EmbeddedVideo(key, record, path.read_bytes()))
    for run, videos in zip(runs, chosen, strict=True):
        videos.sort(key=lambda each, order=run.summary.videos: order.index(each.record))
        videos.sort(key=lambda each: each.record.kind != "model")
    return chosen


def action_traces(
    rows: Sequence[Sequence[float]], action: Mapping[str, Any]
) -> list[tuple[str, str, str]]:
    """Title, colour and curve of each action dimension, scaled by the bounds of the actions.

    A curve is the points of an SVG polyline in a box from (0, 0) to (1, 1), with the upper bound at
    the top. It is a step curve, because an action holds for the whole interval between two frames.

    Args:
        rows: actions `[T, A]`; the last one leads to no frame and is left out.
    """
    last = max(len(rows) - 1, 1)
    traces: list[tuple[str, str, str]] = []
    bounds = zip(action["names"], action["units"], action["low"], action["high"], strict=True)
    for index, (name, unit, low, high) in enumerate(bounds):
        points = [
            f"{(frame + end) / last:.4f},{(high - row[index]) / (high - low):.4f}"
            for frame, row in enumerate(rows[:-1])
            for end in (0, 1)
        ]
        title = name.replace("_", " ") + (f" ({unit})" if unit else "")
        traces.append((title, f"run{index % 6 + 1}", " ".join(points)))  # the page has six colours
    return traces
