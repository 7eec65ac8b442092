"""Counterfactual response: whether the prediction responds to other actions as the truth does."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acwm_core.evaluation.metric import Metric, Prediction
from acwm_metrics.pixel import videos

Sums = NDArray[np.float64]
"""One sum over pixels, channels and branches for each frame, `[T]`."""


class Response(Metric):
    """How well the true response to other actions is predicted.

    Δ is the difference between a branch's predicted video and the factual one, Δ* the true
    difference. The score is 1 − Σ|Δ − Δ*|² / Σ|Δ*|² over pixels, channels and branches. This is the
    skill score (Murphy 1988) of the predicted response, relative to a model that ignores actions.

    1 is the simulator itself. 0 means no response, or for example a thing that correctly leaves its
    place but goes to a wrong one. Half the true response scores 0.75, and so does 1.5 times it;
    twice the response scores 0, and the opposite response −3. There is no lower bound. With the
    gain g = Σ Δ·Δ* / Σ|Δ*|², and e the energy of the rest of Δ relative to Σ|Δ*|², the score is
    1 − (1 − g)² − e.

    Sums are pooled over frames and clips, so clips with a small response count little. Branches
    must be sampled with the same noise as the factual clip. The noise then cancels, and a model
    that ignores its actions scores exactly 0, whatever it predicts.
    """

    name = "response"
    bounds = (-math.inf, 1.0)
    higher_is_better = True
    group = "Actions"
    reads = "pixels"
    of_branches = True

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """Score of each frame over all branches, `[T]`; NaN where there is no true response."""
        errors, energy = response_sums(prediction)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(energy > 0, 1 - errors / energy, np.nan)

    def value(self, prediction: Prediction) -> float:
        """Score over all frames and branches; NaN without a true response."""
        errors, energy = response_sums(prediction)
        return 1 - errors.sum() / energy.sum() if energy.sum() > 0 else float("nan")

    def weight(self, prediction: Prediction) -> float:
        """Energy of the true response: the weighted mean of clips is then their pooled score."""
        return float(response_sums(prediction)[1].sum())


def response_sums(prediction: Prediction) -> tuple[Sums, Sums]:
    """Σ|Δ − Δ*|² and Σ|Δ*|² of each frame over all branches."""
    predicted, true = videos(prediction)
    errors, energy = np.zeros(len(true)), np.zeros(len(true))
    for branch in prediction.branches:
        predicted_branch, true_branch = videos(branch)
        response = true_branch - true
        errors += ((predicted_branch - predicted - response) ** 2).sum((1, 2, 3))
        energy += (response**2).sum((1, 2, 3))
    return errors, energy
