"""Whether two evaluations predicted the same test data, byte for byte or but for rounding.

The same command gives the same bytes on the same kind of processor. On another kind the last digits
of a simulation may differ, and with them a few pixels and every checksum. How far a still picture
is from the truth depends on nothing but the data, so it shows whether the clips are the same.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence

from acwm_core.evaluation.results import Score, Summary

TOLERANCE = 1e-3
"""Share by which the scores of a still picture may differ."""

RECIPE = ("environment", "seed", "options", "factors", "frame_size")
"""The facts of a simulated dataset that determine its test episodes."""

StillScores = Mapping[Hashable, float]
"""Scores of the first frame, repeated."""


def checksums(summary: Summary) -> dict[str, str]:
    """SHA-256 of the test data, by split."""
    return summary.provenance["dataset"]["checksums"]


def given_frames(summary: Summary) -> int:
    """How many first frames of a clip the model was given."""
    return summary.provenance.get("context_frames", 1)


def same_recipe(first: Summary, second: Summary) -> bool:
    """Whether both test data were simulated from the same settings."""
    ours, theirs = (each.provenance["dataset"] for each in (first, second))
    if any(each.get("source") or each["seed"] is None for each in (ours, theirs)):
        return False
    return all(ours.get(name) == theirs.get(name) for name in RECIPE)


def agree(ours: StillScores, theirs: StillScores) -> bool:
    """Whether still pictures have the same scores, as far as both have any."""
    common = ours.keys() & theirs.keys()
    return bool(common) and all(
        math.isclose(ours[key], theirs[key], rel_tol=TOLERANCE, abs_tol=1e-9) for key in common
    )


def still_scores(scores: Sequence[Score], split: str, metrics: Sequence[str]) -> StillScores:
    """The scores of a still picture, by metric and clip."""
    return {
        (name, each.episode, each.start, each.frames): each.values[name]
        for each in scores
        if (each.kind, each.split) == ("copy", split)
        for name in metrics
        if not math.isnan(each.values[name])
    }


def mean_still_scores(summary: Summary) -> StillScores:
    """The mean scores of a still picture, by split and metric."""
    return {
        (split, name): score.value
        for split, each in summary.splits.items()
        for name, score in each.scores.rows.get("copy", {}).items()
        if score.value is not None and summary.metrics[name].reads == "pixels"
    }
