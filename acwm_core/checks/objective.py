"""Checks of an objective: what training and rollouts require of it, on the smallest models."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any, cast, get_args

import torch
from torch import Tensor

from acwm_core.checks.result import NotTried, expect, expect_is_a
from acwm_core.checks.trial import (
    WIDTH,
    PredictionTrial,
    TinyDenoiser,
    TinyPredictor,
    batch_error,
    batch_of,
    noise,
)
from acwm_core.errors import RecipeError
from acwm_core.model.dynamics import Denoiser, DynamicsModel, InputKind, Predictor
from acwm_core.model.objectives.objective import Objective
from acwm_core.model.shapes import Latent

BATCH, FRAMES, CHANNELS, SIDE = 2, 5, 2, 4

LESSONS = 150
"""Steps of the training in which a loss has to fall."""


class ObjectiveChecks(PredictionTrial):
    """Checks of an `acwm_core.model.objectives.objective.Objective` on tiny models.

    Their latents move by what the actions say, so that there is something to learn.
    """

    kind = "objective"

    @functools.cached_property
    def _objective(self) -> Objective[Any]:
        return self.make()

    @functools.cached_property
    def _model(self) -> DynamicsModel:
        return self._fresh_model()

    def _fresh_model(self) -> DynamicsModel:
        cast(Any, torch).manual_seed(0)
        if (example := self._objective.example_model(CHANNELS)) is not None:
            return example
        if issubclass(self._objective.trains, Denoiser):
            return TinyDenoiser(CHANNELS, self._objective.inputs)
        return TinyPredictor(CHANNELS)

    def _inputs(self, batch: int = BATCH, seed: int = 1) -> tuple[Latent, Tensor]:
        modulation = noise((batch, FRAMES, WIDTH), seed)  # of the actions
        start = noise((batch, 1, CHANNELS, SIDE, SIDE), seed + 1)
        moves = modulation[:, :, :CHANNELS].cumsum(1) - modulation[:, :1, :CHANNELS]
        return start + 0.5 * moves[..., None, None], modulation

    def _loss(
        self, model: DynamicsModel, latents: Latent, modulation: Tensor, first: int = 0
    ) -> Tensor:
        """The loss of clips with the noise of clips number `first` and following."""
        return self._objective.loss(model, batch_of(latents, modulation, first=first), 1)

    def can_be_constructed(self) -> None:
        """Construct the objective and find `trains`, `causal`, `inputs` and `steps`."""
        expect_is_a(self._objective, Objective)
        kinds = (Denoiser, Predictor)
        trains: Any = getattr(self._objective, "trains", None)
        fits = isinstance(trains, type) and issubclass(trains, kinds)
        expect(fits, f"trains is {trains!r}, neither Denoiser nor Predictor")
        wrong = [k for k in self._objective.inputs.values() if k not in get_args(InputKind)]
        expect(not wrong, f"inputs has {wrong}, which is neither 'latent' nor 'level'")
        steps: Any = self._objective.steps
        good = steps is None or (isinstance(steps, int) and steps >= 1)
        expect(good, f"steps is {steps!r}, neither None nor at least 1")

    def takes_only_models_that_it_can_train(self) -> None:
        """Let `check_model` accept a model with all that is required, and refuse others."""
        self._objective.check_model(self._model)
        denoises = isinstance(self._model, Denoiser)
        plain = TinyDenoiser(CHANNELS, {})
        others: list[DynamicsModel] = [TinyPredictor(CHANNELS) if denoises else plain]
        others += [plain] if self._objective.inputs else []
        for other in others:
            try:
                self._objective.check_model(other)
            except RecipeError:
                continue
            expect(False, f"it accepts a {type(other).__name__}, which it cannot train")

    def the_loss_is_a_finite_number(self) -> None:
        """Return a finite scalar with a gradient."""
        loss = self._loss(self._model, *self._inputs())
        expect(loss.ndim == 0 and bool(loss.isfinite()), f"the loss is {loss}")
        expect(loss.requires_grad, "no gradient reaches the model")

    def all_randomness_comes_from_the_generators(self) -> None:
        """Give the same loss and prediction for the same generators, whatever torch's state."""
        latents, modulation = self._inputs()
        losses: list[float] = []
        predictions: list[Tensor] = []
        for seed in (1, 2):
            cast(Any, torch).manual_seed(seed)
            losses.append(self._loss(self._model, latents, modulation).item())
            cast(Any, torch).manual_seed(seed)
            predictions.append(self._predict(latents[:, :1], modulation))
        expect(losses[0] == losses[1], "the loss depends on torch's own random numbers")
        same = torch.equal(*predictions)
        expect(same, "predictions depend on torch's own random numbers")

    def clips_of_a_batch_are_independent(self) -> None:
        """Average the loss over clips, and predict a clip the same way beside any others."""
        latents, modulation = self._inputs()
        whole = self._loss(self._model, latents, modulation).item()
        clips = zip(latents[:, None], modulation[:, None], strict=True)
        alone = [self._loss(self._model, *clip, first=k).item() for k, clip in enumerate(clips)]
        mean = sum(alone) / BATCH
        off = abs(whole - mean) / max(abs(mean), 1e-6)
        expect(off < 1e-3, f"the loss of a batch is {whole:.4g}, and {mean:.4g} clip by clip")
        together = self._predict(latents[:, :1], modulation)[:1]
        error = batch_error(together, self._predict(latents[:1, :1], modulation[:1]))
        expect(error < 1e-3, f"predictions change by {error:.2g} with the rest of the batch")

    def weights_count(self) -> None:
        """With `weighs_frames`, multiply the error of each clip's frames by their weights."""
        if not self._objective.weighs_frames:
            raise NotTried("it weighs no frames")
        if type(self._objective).prepare is not cast(Any, Objective).prepare:
            raise NotTried("it may weigh them before the first step")
        latents, modulation = self._inputs()
        weights = torch.tensor([[0.5], [3.0]]).expand(BATCH, FRAMES)
        clips = zip(latents[:, None], modulation[:, None], weights, strict=True)
        parts = [
            self._loss(self._model, *clip, first=number).item() * weight[0].item()
            for number, (*clip, weight) in enumerate(clips)
        ]
        batch = replace(batch_of(latents, modulation), weights=weights)
        whole, mean = self._objective.loss(self._model, batch, 1).item(), sum(parts) / BATCH
        off = abs(whole - mean) / max(abs(mean), 1e-6)
        expect(off < 1e-3, f"the weighed loss is {whole:.4g}, and not {mean:.4g}")

    def training_lowers_the_loss(self) -> None:
        """Train a tiny model so that the loss on other clips falls."""
        model = self._fresh_model()
        optimizer: Any = torch.optim.Adam(model.parameters(), 1e-2)
        others = self._inputs(32, seed=500)
        before = self._loss(model, *others).item()
        for lesson in range(LESSONS):
            optimizer.zero_grad()
            clips = self._inputs(16, lesson * 2)
            loss: Any = self._loss(model, *clips, first=lesson * 16)
            loss.backward()
            optimizer.step()
        after = self._loss(model, *others).item()
        expect(after < before, f"the loss goes from {before:.3g} to {after:.3g} in training")

    def heeds_the_number_of_steps(self) -> None:
        """With `steps`, evaluate the network more often for more steps."""
        if self._objective.steps is None:
            raise NotTried("it has no sampling steps")
        latents, modulation = self._inputs()
        few, many = (self._predict(latents[:, :1], modulation, steps=steps) for steps in (1, 4))
        expect(not torch.equal(few, many), "one step and four give the same prediction")

    def streams_or_refuses_to(self) -> None:
        """Stream finite frames after 1 or 2 given ones, or refuse to with a `RecipeError`."""
        for known in (1, 2):
            self._streamed(known)
