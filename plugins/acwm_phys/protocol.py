"""The clips that ACWM-Phys (arXiv 2605.08567) evaluates on."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np

from acwm_core.evaluation.protocol import Protocol, PublishedTable

DRAW_SEED = 0
"""Seed of the published draw of episodes, independent of `evaluation.seed`."""


class PublishedWindows(Protocol):
    """Windows of 37 frames, ten from each of at most 50 episodes.

    The published sampler has 50 points and so 49 evaluations, see `Flow`. A whole
    window is predicted at once, from one context frame.
    """

    defaults: Mapping[str, Any] = {
        **{"frames": 37, "cuts": 10, "episodes": 50, "steps": 49},
        **{"mode": "windows", "context_frames": 1},
    }
    cuts_windows = True
    from_first_frame = False

    def tables(self) -> Mapping[str, PublishedTable]:
        """The tables of the paper."""
        from acwm_phys.tables import published_tables

        return published_tables()

    def episodes(self, count: int, wanted: int | None) -> list[int]:
        """A fixed draw by Python's generator, ``random.Random(0).sample``."""
        drawn = random.Random(DRAW_SEED).sample(range(count), min(count, wanted or count))
        return sorted(drawn)

    def windows(self, length: int, frames: int | None, cuts: int | None) -> list[tuple[int, int]]:
        """Windows that start at ``linspace(0, length − frames, cuts)``, rounded down.

        Duplicate starts, in episodes hardly longer than a window, are used once. An episode shorter
        than a window is a single, shorter clip.
        """
        frames = min(length, frames or length)
        starts = np.linspace(0, length - frames, cuts or 1).astype(int)
        return [(start, frames) for start in np.unique(starts).tolist()]
