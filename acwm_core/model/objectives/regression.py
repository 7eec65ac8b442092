"""Regression: the squared error of a prediction without noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import RecipeError, check_shape
from acwm_core.model.dynamics import DynamicsModel, LatentStream, Predictor
from acwm_core.model.objectives.objective import Batch, Objective
from acwm_core.model.shapes import Latent


class Regression(Objective[Predictor]):
    """Mean squared error of the predicted latents, with gradients through the whole clip.

    A model therefore predicts means: what cannot be known becomes blurred. Only one that draws its
    pictures from states (`Predictor.follows_states`), which are true ones here, may draw futures.

    Args:
        state_weight: weight of the model's loss of the agent's states, if it learns some.
        frames: number of latent frames of each clip, drawn at random, that a training step
            compares; None for all. Frames of a clip are much alike: where a model saves the work
            for the others, more clips in the same time teach it more.

    Raises:
        RecipeError: no frames, or a model that saves no work (`Predictor.skips`).
    """

    trains = Predictor
    learns_states = True

    def __init__(self, *, state_weight: float = 0.3, frames: int | None = None) -> None:
        if frames is not None and frames < 1:
            raise RecipeError(f"objective.frames is {frames}; it must be at least 1")
        self.state_weight = state_weight
        self.frames = frames

    def check_model(self, model: DynamicsModel) -> None:
        """Refuse a model that cannot learn by it, or not all that it could; see `Objective`."""
        super().check_model(model)
        follows = isinstance(model, Predictor) and model.follows_states
        if model.samples and not self.draws and not follows:
            raise RecipeError(
                f"{type(self).__name__} teaches the mean of all futures, but "
                f"{type(model).__name__} draws one: set objective=energy_score, or model.noise=0"
            )

    def loss(self, model: Predictor, batch: Batch, known: int) -> Tensor:
        """Mean squared error of the latents after the given ones; see `Objective.loss`."""
        loss = self.picture_loss(model, batch, known)
        return loss if batch.states is None else loss + self.state_weight * model.state_loss(batch)

    def picture_loss(self, model: Predictor, batch: Batch, known: int) -> Tensor:
        """The loss of the predicted pictures, a scalar."""
        predicted, true = self.predicted(
            model, batch, known, self.compared_frames(model, batch, known)
        )
        return functional.mse_loss(predicted.float(), true.float())

    def predicted(
        self, model: Predictor, batch: Batch, known: int, only: Tensor | None
    ) -> tuple[Latent, Latent]:
        """Predicted and true latents, each `[B, N, C, h, w]`, of all frames or of `only` some."""
        beginning = replace(batch, latents=batch.latents[:, :known])
        made = _predicted(model, beginning, batch.latents.shape[1], only, taught=model.training)
        true = batch.latents[:, known:]
        if only is not None:
            true = true.take_along_dim(only[..., None, None, None], 1)
        return made, true

    def predict(
        self, model: Predictor, given: Batch, frames: int, steps: int | None = None
    ) -> Latent:
        """Predict the clip in one pass; see `Objective.predict`."""
        latents = given.latents
        return torch.cat([latents, _predicted(model, given, frames).to(latents)], 1)

    def predict_frames(
        self,
        model: Predictor,
        given: Batch,
        frames: int,
        only: Sequence[int],
        steps: int | None = None,
    ) -> Latent:
        """Predict these frames of the clip; see `Objective.predict_frames`."""
        if not model.skips:
            return super().predict_frames(model, given, frames, only, steps)
        batch, known = given.latents.shape[:2]
        numbers = torch.tensor([[number - known for number in only]], device=given.latents.device)
        made = _predicted(model, given, frames, numbers.expand(batch, -1))
        return made.to(given.latents)

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

    def compared_frames(self, model: Predictor, batch: Batch, known: int) -> Tensor | None:
        """The frames of each clip to compare, `[B, N]`; None for all, as in validation.

        Raises:
            RecipeError: the model saves no work.
        """
        if self.frames is None:
            return None
        if not model.skips:
            raise RecipeError(
                f"{type(model).__name__} predicts all frames of a clip or none: leave out "
                "objective.frames"
            )
        predicted = batch.latents.shape[1] - known
        return batch.picked(self.frames, predicted) if model.training else None


def _predicted(
    model: Predictor,
    given: Batch,
    frames: int,
    only: Tensor | None = None,
    *,
    taught: bool = False,
) -> Latent:
    """The predicted frames; `taught` is teacher forcing, for models that follow states."""
    batch, known, *size = given.latents.shape
    further = _drawing(model, given.generators)
    if only is not None:
        further["only"] = only
    if taught and model.follows_states:
        further["states"] = given.states
    made = model(given.latents, given.conditioning, frames, **further)
    number = frames - known if only is None else only.shape[1]
    check_shape(model, "forward", made, batch, number, *size)
    return made


def _drawing(model: Predictor, generators: Sequence[torch.Generator]) -> dict[str, Any]:
    """The further argument of a predictor that draws."""
    return {"generators": generators} if model.samples else {}
