"""Regression: the squared error of a prediction without noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import check_shape
from acwm_core.model.dynamics import LatentStream, Predictor
from acwm_core.model.objectives.objective import Batch, Objective
from acwm_core.model.shapes import Latent


class Regression(Objective[Predictor]):
    """Mean squared error of the predicted latents, with gradients through the whole clip.

    A model therefore predicts means: what cannot be known becomes blurred.

    Args:
        state_weight: weight of the model's loss of the agent's states, if it learns some.
    """

    trains = Predictor
    learns_states = True

    def __init__(self, *, state_weight: float = 0.3) -> None:
        self.state_weight = state_weight

    def loss(self, model: Predictor, batch: Batch, known: int) -> Tensor:
        """Mean squared error of the latents after the given ones; see `Objective.loss`."""
        given, true = batch.latents[:, :known], batch.latents[:, known:]
        predicted = _predicted(model, replace(batch, latents=given), batch.latents.shape[1])
        loss = functional.mse_loss(predicted.float(), true.float())
        return loss if batch.states is None else loss + self.state_weight * model.state_loss(batch)

    def predict(
        self, model: Predictor, given: Batch, frames: int, steps: int | None = None
    ) -> Latent:
        """Predict the clip in one pass; see `Objective.predict`."""
        latents = given.latents
        return torch.cat([latents, _predicted(model, given, frames).to(latents)], 1)

    def stream(
        self,
        model: Predictor,
        given: Latent,
        generators: Sequence[torch.Generator],
        *,
        steps: int | None = None,
        context: int,
    ) -> LatentStream:
        """The model's own stream; see `Predictor.stream`."""
        return model.stream(given, context=context, **_drawing(model, generators))

    def streams_by_default(self, model: Predictor) -> bool:
        """Whether the model has a stream: it was trained to carry its state over the clip."""
        return model.streams


def _predicted(model: Predictor, given: Batch, frames: int) -> Latent:
    batch, known, *size = given.latents.shape
    drawing = _drawing(model, given.generators)
    made = model(given.latents, given.conditioning, frames, **drawing)
    check_shape(model, "forward", made, batch, frames - known, *size)
    return made


def _drawing(model: Predictor, generators: Sequence[torch.Generator]) -> dict[str, Any]:
    """The further argument of a predictor that draws."""
    return {"generators": generators} if model.samples else {}
