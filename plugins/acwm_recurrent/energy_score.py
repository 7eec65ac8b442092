"""Energy score: a model learns to draw futures that are as near and as different as true ones."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.model.dynamics import Predictor
from acwm_core.model.objectives.objective import Batch
from acwm_core.model.objectives.regression import Regression

SCALES = (1, 2, 4)
"""Sides of the patches, in cells of the latent, whose differences are measured."""

LEAST = 1e-6
"""Added to squared differences, as the square root has no gradient at zero."""


class EnergyScore(Regression):
    """The energy score of two draws per clip (Gneiting and Raftery 2007, eq. 22).

    ½ (‖x₁ − y‖ + ‖x₂ − y‖) − ½ ‖x₁ − x₂‖, the mean over patches of several sizes, each a Euclidean
    norm. Its expectation is least if draws have the distribution of the true futures: draws that
    are all the same pay for being wrong, and draws that differ for no reason pay, too.

    Args:
        state_weight: weight of the model's loss of the agent's states, if it learns some.
        frames: number of latent frames of each clip that a training step compares; see
            `Regression`.
    """

    draws = True

    def picture_loss(self, model: Predictor, batch: Batch, known: int) -> Tensor:
        """The energy score of two draws, a scalar."""
        only = self.compared_frames(model, batch, known)
        first, true = self.predicted(model, batch, known, only)
        second, _ = self.predicted(model, batch, known, only)
        far = distance(first, true) + distance(second, true)
        return (far - distance(first, second)) / 2


def distance(first: Tensor, second: Tensor) -> Tensor:
    """The mean Euclidean distance of the patches of latents `[B, L, C, h, w]`, a scalar."""
    squared = (first.float() - second.float()).square().mean(2).flatten(0, 1)[:, None]
    means = [functional.avg_pool2d(squared, side, max(side // 2, 1)) for side in SCALES]
    return torch.stack([(each + LEAST).sqrt().mean() for each in means]).mean()
