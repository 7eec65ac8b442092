"""Counterfactual response: does the prediction respond to other actions as the true video does?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acwm_core.metric import Metric, Rollout
from acwm_metrics.pixel import videos

Sums = NDArray[np.float64]
"""One sum over pixels, channels and branches for each frame, `[T]`."""


class Response(Metric):
    """How much of the true response to other actions is predicted, and nothing else.

    Δ is the difference of a branch's video from the factual one, Δ* the true difference. The score
    is 1 − Σ|Δ − Δ*|² / Σ|Δ*|² over pixels, channels and branches: the skill score (Murphy 1988) of
    the predicted response against that of a model that ignores its actions.

    1 is the simulator itself. 0 is no response, or a thing that rightly leaves its place, for a
    wrong one. Half the response and one and a half of it have 0.75 each, twice the response 0 and
    the opposite one −3; there is no least value. With g = Σ Δ·Δ* / Σ|Δ*|², the gain, and e the
    energy of what is left of Δ relative to Σ|Δ*|², it is 1 − (1 − g)² − e.

    Sums are pooled over frames and clips, so what hardly responds hardly counts. Branches are to be
    sampled with the noise of the factual clip: noise that is the same in both cancels, and a model
    that ignores its actions has exactly 0, whatever it predicts.
    """

    name = "response"
    higher_is_better = True
    group = "Actions"
    reads = "pixels"
    of_branches = True

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame over all branches, `[T]`; NaN where the truth does not respond."""
        errors, energy = response_sums(rollout)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(energy > 0, 1 - errors / energy, np.nan)

    def value(self, rollout: Rollout) -> float:
        """Over all frames and branches; NaN without a true response."""
        errors, energy = response_sums(rollout)
        return 1 - errors.sum() / energy.sum() if energy.sum() > 0 else float("nan")

    def weight(self, rollout: Rollout) -> float:
        """Energy of the true response, so that the weighted mean of clips is their pooled score."""
        return float(response_sums(rollout)[1].sum())


def response_sums(rollout: Rollout) -> tuple[Sums, Sums]:
    """Σ|Δ − Δ*|² and Σ|Δ*|² of each frame over all branches.

    Raises:
        ShapeError: prediction and target of the clip or a branch differ in shape.
    """
    predicted, true = videos(rollout)
    errors, energy = np.zeros(len(true)), np.zeros(len(true))
    for branch in rollout.branches:
        predicted_branch, true_branch = videos(branch)
        response = true_branch - true
        errors += ((predicted_branch - predicted - response) ** 2).sum((1, 2, 3))
        energy += (response**2).sum((1, 2, 3))
    return errors, energy
