"""Estimates with confidence intervals, and tests of differences. Needs only NumPy and pydantic."""

from acwm_core.evaluation.statistics.bootstrap import (
    CONFIDENCE,
    MIN_EPISODES,
    RESAMPLES,
    Estimate,
    PairedDifference,
    defined,
    finite,
    holm,
    paired_bootstrap,
)
from acwm_core.evaluation.statistics.scores import (
    ClipScores,
    Paired,
    Summarise,
    compare,
    gap_between,
)

__all__ = [
    "CONFIDENCE",
    "MIN_EPISODES",
    "RESAMPLES",
    "ClipScores",
    "Estimate",
    "Paired",
    "PairedDifference",
    "Summarise",
    "compare",
    "defined",
    "finite",
    "gap_between",
    "holm",
    "paired_bootstrap",
]
