"""The row `perturbed`, and how long an environment can be foreseen."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.simulate import simulate
from acwm_core.environment import Environment
from acwm_core.evaluation.clip_results import ClipResult
from acwm_core.evaluation.estimates import finite
from acwm_core.evaluation.findings import Predictability
from acwm_core.evaluation.plans import ClipPlan
from acwm_core.evaluation.protocol import as_clip, load_samples
from acwm_core.evaluation.scoring import Prediction

PERTURBATION = 1.0
"""Millimetres and milliradians by which the start is off."""

UNFORESEEABLE = 0.5
"""Share of the still first frame's squared error at which a frame cannot be foreseen. Another
episode of the same world would have a share of about 2, a perfect copy 0."""

Score = Callable[[Prediction], ClipResult]


def perturbed_rows(
    environment: Environment, plans: Sequence[ClipPlan], episodes: EpisodeDataset, score: Score
) -> tuple[list[ClipResult], Predictability]:
    """Simulate clips once more from a slightly different start, and score that as a prediction.

    Args:
        environment: what simulated the episodes.
        plans: clips that begin with their episode.
        episodes: of the split.
        score: scores a prediction.
    """
    results: list[ClipResult] = []
    errors: list[NDArray[np.float64]] = []
    for sample in load_samples(plans, episodes):
        clip, frames = sample.episode, len(sample.video)
        moved = simulate(
            environment, clip.spec, clip.actions, frames=frames, perturbation=PERTURBATION
        )
        video = as_clip(moved.video)
        results.append(score(Prediction(sample, "perturbed", video)))
        both = (video, sample.video[:1])
        errors.append(np.stack([((each - sample.video) ** 2).mean((1, 2, 3)) for each in both]))
    return results, predictability(errors)


def predictability(errors: Sequence[NDArray[np.float64]]) -> Predictability:
    """How long clips can be foreseen.

    Args:
        errors: of each clip the squared errors `[2, T]` of the perturbed simulation and of the
            first frame, frame by frame.
    """
    pooled = np.zeros((2, max(each.shape[1] for each in errors)))
    for each in errors:
        pooled[:, : each.shape[1]] += each
    share = np.full(pooled.shape[1], np.nan)
    np.divide(pooled[0], pooled[1], out=share, where=pooled[1] > 0)
    foreseen = np.flatnonzero(~(share >= UNFORESEEABLE))
    first = int(foreseen[-1]) + 1 if len(foreseen) else 0
    horizon = first if first < len(share) else None
    return Predictability(len(errors), [finite(s) for s in share], horizon, UNFORESEEABLE)
