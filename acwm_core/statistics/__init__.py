"""Estimates with intervals, differences larger than chance, means over seeds. Numpy only."""

from acwm_core.statistics.bootstrap import (
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
from acwm_core.statistics.scores import ClipScores, Paired, Summarise, compare, gap_between
from acwm_core.statistics.seeds import OverSeeds, difference_over_seeds, over_seeds

__all__ = [
    "CONFIDENCE",
    "MIN_EPISODES",
    "RESAMPLES",
    "ClipScores",
    "Estimate",
    "OverSeeds",
    "Paired",
    "PairedDifference",
    "Summarise",
    "compare",
    "defined",
    "difference_over_seeds",
    "finite",
    "gap_between",
    "holm",
    "over_seeds",
    "paired_bootstrap",
]
