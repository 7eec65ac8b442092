"""The videos of a report: which are embedded, and what stands around them."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from acwm_core.errors import DataError
from acwm_core.evaluation.results import FOLDER, VIDEOS, Summary, VideoRecord
from acwm_core.report.traces import Trace, action_traces
from acwm_core.report.wording import Scale, branch_title, label_title, metric_title, split_title

MEGABYTES = 16
"""Size of the videos that a report embeds by default, before base64 adds a third."""

BRANCH = "branch:"
"""Begins the kind of a video that answers other actions from the same first frame."""

PICKS = ("median", "worst", "best")
"""In which order picks are embedded as long as there is room."""


@dataclass(frozen=True)
class Film:
    """A video on the page.

    Attributes:
        key: its id on the page.
        data: MP4 in base64.
        title: why it is here.
        score: the headline metric, or empty.
        about: which clip it is.
        panels: what its panels show, row by row.
        traces: the actions that the model was given.
    """

    key: str
    data: Markup
    title: str
    score: str
    about: str
    panels: list[list[str]]
    traces: list[Trace]


@dataclass(frozen=True)
class FilmGroup:
    """Videos of one split beside one another."""

    title: str
    films: list[Film]


@dataclass(frozen=True)
class Reel:
    """The videos of one run.

    Attributes:
        cases: case studies, split by split.
        branches: videos of other actions from one first frame, split by split.
        size: megabytes of what is embedded.
        left_out: how many videos lie in the run's folder only.
    """

    cases: list[FilmGroup]
    branches: list[FilmGroup]
    size: float
    left_out: int


def choose_films(
    folders: Sequence[Path], summaries: Sequence[Summary], megabytes: float = MEGABYTES
) -> list[set[str]]:
    """Which videos of each run are embedded: what matters most comes first, run by run.

    Medians before worst and best clips, before those with other actions; a video that does not fit
    into the room that is left is passed over.

    Raises:
        DataError: a video is missing.
    """
    room = megabytes * 1e6
    candidates = [
        (_rank(record), number, index)
        for number, summary in enumerate(summaries)
        for index, record in enumerate(summary.videos)
    ]
    chosen: list[set[str]] = [set() for _ in folders]
    for _, number, index in sorted(candidates):
        file = summaries[number].videos[index].file
        size = _path(folders[number], file).stat().st_size
        if size <= room:
            room -= size
            chosen[number].add(file)
    return chosen


def reel(folder: Path, summary: Summary, key: str, chosen: set[str]) -> Reel:
    """The chosen videos of a run; `key` makes their ids unique on the page."""
    shown = [record for record in summary.videos if record.file in chosen]
    films = {record.file: _film(folder, summary, record, key) for record in shown}
    size = sum(_path(folder, file).stat().st_size for file in films) / 1e6
    branches = [record for record in shown if record.kind.startswith(BRANCH)]
    # The median comes last, beside itself with other actions.
    cases = [record for record in shown if not record.kind.startswith(BRANCH)]
    cases.sort(key=lambda record: (record.pick == "median", record.kind != "model"))
    return Reel(
        _groups(cases, films, summary),
        _groups(branches, films, summary),
        size,
        len(summary.videos) - len(shown),
    )


def film_key(key: str, record: VideoRecord) -> str:
    """The id of a video on the page."""
    return f"{key}-{record.file.removesuffix('.mp4')}".replace(":", "-").replace(" ", "-")


def _rank(record: VideoRecord) -> tuple[int, int]:
    if record.kind.startswith(BRANCH):
        return 2, 0
    if record.kind != "model":
        return 1, 0
    return 0, PICKS.index(record.pick) if record.pick in PICKS else len(PICKS)


def _groups(
    records: Sequence[VideoRecord], films: Mapping[str, Film], summary: Summary
) -> list[FilmGroup]:
    groups = [
        FilmGroup(split_title(split), [films[r.file] for r in records if r.split == split])
        for split in summary.splits
    ]
    return [group for group in groups if group.films]


def _film(folder: Path, summary: Summary, record: VideoRecord, key: str) -> Film:
    value = record.values.get(summary.headline)
    scale = Scale.of([value], summary.metrics[summary.headline].unit)
    score = f"{metric_title(summary.headline)} {scale.number(value)} {scale.unit}".strip()
    about = f"Episode {record.episode}" + f", from frame {record.start}" * bool(record.start)
    if record.ood_label:
        about += f", shifted: {label_title(record.ood_label)}"
    if record.kind.startswith(BRANCH):
        title = branch_title(record.kind.removeprefix(BRANCH))
    else:
        title = record.pick.capitalize() + ", other actions" * (record.kind == "shuffled")
    return Film(
        key=film_key(key, record),
        data=Markup(base64.b64encode(_path(folder, record.file).read_bytes()).decode()),
        title=title,
        score=score if value is not None else "",
        about=about,
        panels=record.panels,
        traces=action_traces(record.actions, summary.environment["action"]),
    )


def _path(folder: Path, file: str) -> Path:
    """The file of a video.

    Raises:
        DataError: it is missing.
    """
    path = folder / FOLDER / VIDEOS / file
    if not path.is_file():
        raise DataError(f"the video {path} is missing: run `acwm evaluate {folder}` again")
    return path
