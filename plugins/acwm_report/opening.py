"""What a report begins with: a typical clip in motion, and the three figures that matter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from acwm_core.evaluation.results import DIVIDER, Estimate
from acwm_report.run import EvaluatedRun
from acwm_report.table import Scale
from acwm_report.titles import OVER, split_title
from acwm_report.videos import EmbeddedVideo

PANELS = ("truth", "prediction", "difference")
"""The panels of a video that the opening shows side by side."""


@dataclass(frozen=True)
class Figure:
    """A number in large print."""

    number: str
    unit: str
    label: str
    notes: Sequence[str] = ()  # small print below the label


@dataclass(frozen=True)
class Pane:
    """A panel of a video and its place in the grid of panels."""

    name: str
    row: int
    column: int


@dataclass(frozen=True)
class Opening:
    """The moving comparison: panels of a video that stands elsewhere on the page."""

    video: EmbeddedVideo
    about: str  # which clip it is
    panes: Sequence[Pane]
    size: tuple[int, int]  # height and width of a panel before it was magnified
    divider: int = DIVIDER  # width of the line between panels


def opening(run: EvaluatedRun, videos: Sequence[EmbeddedVideo]) -> Opening | None:
    """The median clip of the first split, or what is nearest to it; None without videos."""
    own = _typical_first(run, videos)
    return _opening(run, own[0], PANELS) if own else None


def tracked(run: EvaluatedRun, videos: Sequence[EmbeddedVideo]) -> list[Opening]:
    """The most typical clip of each split in which the model sees things."""
    found: dict[str, EmbeddedVideo] = {}
    for each in _typical_first(run, videos):
        if each.record.tracks and each.record.tracks.names:
            found.setdefault(each.record.split, each)
    return [_opening(run, each, PANELS[:2]) for each in found.values()]


def _typical_first(run: EvaluatedRun, videos: Sequence[EmbeddedVideo]) -> list[EmbeddedVideo]:
    splits = [*run.summary.splits]
    rank = {"median": 0, "worst": 1, "best": 2}
    own = [each for each in videos if each.record.kind == "model"]
    return sorted(own, key=lambda v: (splits.index(v.record.split), rank.get(v.record.pick, 3)))


def _opening(run: EvaluatedRun, video: EmbeddedVideo, names: Sequence[str]) -> Opening:
    record = video.record
    places = {
        name: Pane(name, row, column)
        for row, of_row in enumerate(record.panels)
        for column, name in enumerate(of_row)
    }
    about = f"{record.pick} clip by {run.headline.title}, {split_title(record.split).lower()}"
    height, width = run.summary.provenance["dataset"]["frame_size"]
    panes = [places[name] for name in names if name in places]
    return Opening(video, about[0].upper() + about[1:], panes, (height, width))


def main_figures(run: EvaluatedRun) -> list[Figure]:
    """The score of the first split, and what it is above a still picture and other actions."""
    metric, scale, info = run.summary.headline, run.headline_scale(), run.headline
    (_, result), *others = run.summary.splits.items()
    score = result.scores.rows["model"][metric]
    elsewhere = [
        f"{split_title(split).lower()}: {scale.number(each.scores.rows['model'][metric].value)}"
        for split, each in others
    ]
    way = "higher" if info.higher_is_better else "lower"
    label = f"{info.title} of the prediction, {way} is better"
    found = [
        Figure(scale.number(score.value), scale.unit, label, [*_interval(scale, score), *elsewhere])
    ]
    for baseline, gain in run.gains(result.scores).items():
        pair = result.scores.paired[baseline][metric]
        notes = [
            *_interval(scale, gain, signed=True),
            f"better in {pair.better}/{pair.clips} clips",
        ]
        number = scale.number(gain.value, signed=True)
        found.append(Figure(number, scale.unit, f"over {OVER[baseline]}", notes))
    return found


def _interval(scale: Scale, estimate: Estimate, *, signed: bool = False) -> list[str]:
    text = scale.interval(estimate, signed=signed)
    return [f"95 %: {text}"] if text else []
