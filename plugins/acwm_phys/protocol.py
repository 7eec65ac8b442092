"""The clips on which ACWM-Phys (arXiv 2605.08567) measures."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from acwm_core.evaluation.benchmark import Protocol

if TYPE_CHECKING:
    from acwm_core.evaluation.config import EvaluationConfig

DRAW_SEED = 0
"""Of the draw of episodes, as published, whatever `evaluation.seed` is."""


class PublishedWindows(Protocol):
    """Windows of 37 frames, ten of each of at most 50 episodes.

    The published sampler has 50 points and so 49 evaluations, see `acwm_core.flow.Flow`. All of a
    window is predicted at once, from one given frame.
    """

    defaults: Mapping[str, Any] = {
        **{"frames": 37, "cuts": 10, "episodes": 50, "steps": 49},
        **{"mode": "windows", "context_frames": 1},
    }
    cuts_windows = True
    from_first_frame = False

    def episodes(self, count: int, config: EvaluationConfig) -> list[int]:
        """A fixed draw by Python's own generator, ``random.Random(0).sample``."""
        wanted = min(count, config.episodes or count)
        return sorted(random.Random(DRAW_SEED).sample(range(count), wanted))

    def windows(self, length: int, config: EvaluationConfig) -> list[tuple[int, int]]:
        """Windows that start at ``linspace(0, length − frames, cuts)`` without their fractions.

        A start that comes twice, because the episode is hardly longer than a window, is taken once,
        and an episode shorter than a window is one clip, shorter too.
        """
        frames = min(length, config.frames or length)
        starts = np.linspace(0, length - frames, config.cuts or 1).astype(int)
        return [(start, frames) for start in np.unique(starts).tolist()]
