"""`Study`: what an evaluation measures besides its rows, on the same clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.evaluation.clips import Clip
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.results import Score
from acwm_core.evaluation.videos import ClipVideo

Clips = Mapping[str, Sequence[Clip]]
"""Clips by split."""


@dataclass(frozen=True)
class Findings:
    """What a study adds to the results of an evaluation.

    Attributes:
        scores: scores of further rows, by split.
        splits: values of fields of `SplitSummary`, by split and field.
        summary: values of fields of `Summary`.
        videos: further videos.
        left_out: what could not be measured, and why; see `Summary.left_out`.
    """

    scores: Mapping[str, Sequence[Score]] = field(default_factory=dict[str, list[Score]])
    splits: Mapping[str, Mapping[str, Any]] = field(default_factory=dict[str, dict[str, Any]])
    summary: Mapping[str, Any] = field(default_factory=dict[str, Any])
    videos: Sequence[ClipVideo] = ()
    left_out: Mapping[str, str] = field(default_factory=dict[str, str])


class Study(Protocol):
    """What `evaluate_run` may be given to measure besides."""

    def count_rows(self, evaluator: Evaluator, clips: Clips) -> int:
        """At most as many as `run` reports to `Evaluator.advance`, for the progress bar."""
        ...

    def run(
        self, evaluator: Evaluator, clips: Clips, datasets: Mapping[str, EpisodeDataset]
    ) -> Findings:
        """Measure it on these clips of these datasets, by split."""
        ...
