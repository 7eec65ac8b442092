"""Regression: the squared error of a prediction without noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import RecipeError, check_shape
from acwm_core.model.batch import Batch, weighed
from acwm_core.model.dynamics import DynamicsModel, LatentStream, Predictor
from acwm_core.model.objectives.objective import Objective
from acwm_core.model.shapes import Latent


class Regression(Objective[Predictor]):
    """Mean squared error of the predicted latents, with gradients through the whole clip.

    A model therefore predicts means: what cannot be known becomes blurred.

    Args:
        frames: number of latent frames of each clip, drawn at random, that a training step
            compares; None for all. Frames of a clip are much alike: where a model saves the work
            for the others (`Predictor.predict_frames`), more clips in the same time teach it more.

    Raises:
        RecipeError: no frames.
    """

    trains = Predictor
    weighs_frames = True

    def __init__(self, *, frames: int | None = None) -> None:
        if frames is not None and frames < 1:
            raise RecipeError(f"objective.frames is {frames}; it must be at least 1")
        self.frames = frames

    def check_model(self, model: DynamicsModel) -> None:
        """Refuse a model that it cannot train; see `Objective.check_model`."""
        super().check_model(model)
        if model.samples:
            raise RecipeError(
                f"{type(self).__name__} teaches the mean of all futures, but "
                f"{type(model).__name__} draws one: set model.noise=0"
            )

    def loss(self, model: Predictor, batch: Batch, known: int) -> Tensor:
        """Mean squared error of the latents after the given ones; see `Objective.loss`."""
        numbers = self.compared_frames(model, batch, known)
        beginning = replace(batch, latents=batch.latents[:, :known])
        predicted = _predicted(model, beginning, batch.latents.shape[1], numbers)
        true = frames_of(batch, known, numbers)
        if batch.weights is None:
            return functional.mse_loss(predicted.float(), true.float())
        errors = (predicted.float() - true.float()).square().flatten(2).mean(2)
        weights = batch.weights[:, known:]
        compared = weights if numbers is None else weights.take_along_dim(numbers, 1)
        return weighed(errors, compared).mean()

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
        batch, known = given.latents.shape[:2]
        numbers = torch.tensor([[number - known for number in only]], device=given.latents.device)
        predicted = _predicted(model, given, frames, numbers.expand(batch, -1))
        return predicted.to(given.latents)

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
        return model.stream(given, context=context, generators=generators)

    def streams_by_default(self, model: Predictor) -> bool:
        """Whether the model has a stream: it was trained to carry its state over the clip."""
        return model.implements("stream")

    def compared_frames(self, model: Predictor, batch: Batch, known: int) -> Tensor | None:
        """The frames of each clip to compare, `[B, N]`; None for all, as in validation."""
        if self.frames is None or not model.training:
            return None
        return batch.random_frames(self.frames, batch.latents.shape[1] - known)


def frames_of(batch: Batch, known: int, numbers: Tensor | None) -> Latent:
    """The true latents after the given ones, `[B, N, C, h, w]`: all, or those of `numbers`."""
    true = batch.latents[:, known:]
    return true if numbers is None else true.take_along_dim(numbers[..., None, None, None], 1)


def _predicted(
    model: Predictor, given: Batch, frames: int, numbers: Tensor | None = None
) -> Latent:
    """The predicted frames: all, or those of `numbers`."""
    batch, known, *size = given.latents.shape
    # One that does not draw gets none, as a compiled model takes no generators.
    generators = given.generators if model.samples else ()
    if numbers is None:
        method, count = "forward", frames - known
        predicted = model(given.latents, given.conditioning, frames, generators)
    else:
        method, count = "predict_frames", numbers.shape[1]
        predicted = model.predict_frames(
            given.latents, given.conditioning, frames, numbers, generators
        )
    check_shape(model, method, predicted, batch, count, *size)
    return predicted
