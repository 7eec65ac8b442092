"""Flow matching on latents: noise path, shifted schedule, loss and Euler sampler.

The path is the straight line x_σ = (1 − σ) · x + σ · ε between a clean latent x and noise ε
(Lipman et al. 2023; Liu et al. 2023); its velocity is ε − x. The first latent frames are given:
they stay clean (σ = 0) and have no loss.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Generic, Literal, TypeVar

import torch
from torch import Tensor

from acwm_core.errors import RecipeError, check_shape
from acwm_core.model.batch import Batch, noise_of_clips, to_device, weighed
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Denoiser, LatentStream
from acwm_core.model.objectives.objective import Objective
from acwm_core.model.shapes import Latent, Sigmas

TRAINING_POINTS = 1000
"""Number of points of the schedule that training draws from (the published value)."""

MIN_SIGMA = 1e-3
"""Smallest noise level by which to divide when a clean latent is converted to a velocity."""

Space = Literal["velocity", "clean"]

Evaluate = Callable[[Latent, Sigmas], Latent]
"""An evaluation of the network: maps noisy latents and noise levels to its prediction."""


def shifted_schedule(points: int, shift: float) -> Tensor:
    """Noise levels from 1 to 0, `[points]` float64, shifted towards noise by `shift`.

    σ' = s·σ / (1 + (s − 1)·σ) on a uniform grid (Esser et al. 2024, eq. 23); s = 1 is uniform.
    """
    sigma = torch.linspace(1, 0, points, dtype=torch.float64)
    return shift * sigma / (1 + (shift - 1) * sigma)


def gaussian_weights(sigma: Tensor) -> Tensor:
    """The published loss weights: a Gaussian around σ = 0.5, shifted to minimum 0, with mean 1.

    exp(−2 ((1000σ − 500) / 1000)²) minus its minimum over the schedule (arXiv 2605.08567,
    appendix on flow matching). It is 0 at both ends of the schedule.
    """
    weights = torch.exp(-2 * (sigma - 0.5) ** 2)
    weights = weights - weights.min()
    return weights / weights.mean()


FlowT = TypeVar("FlowT", bound="FlowMatching")


class FlowStream(LatentStream, Generic[FlowT]):
    """A running prediction of a denoiser, which caches what it computed for earlier frames."""

    def __init__(
        self,
        objective: FlowT,
        model: Denoiser,
        given: Latent,
        generators: Sequence[torch.Generator],
        steps: int | None,
        context: int,
    ) -> None:
        self.objective, self.steps = objective, steps
        self.model, self.cache = model, model.new_cache(context)
        self.generators = generators
        self.last = given  # the given frames, and later the last one

    def noise(self) -> Latent:
        """Standard normal noise for the next latent frame, `[B, 1, C, h, w]`."""
        return to_device(noise_of_clips((1, *self.last.shape[2:]), self.generators), self.last)


class FlowMatching(Objective[Denoiser]):
    """What all objectives of flow matching share: the path, its schedule, the loss, the sampler.

    This class itself trains on one noise level per latent frame, and samples all frames of a clip
    together. The network is called with noisy latents and levels alone.

    Args:
        shift: shifts the schedule towards noise, for training and sampling. The paper uses 5. At
            small scale, models learned actions with 20 but not with 5, because slightly noisy
            latents still show where things move.
        prediction: what the network predicts, the velocity or the clean latent.
        loss_on: the space in which the squared error is computed.
        weighting: `gaussian` is the published weight over noise levels; `none` weighs all equally.
        steps: network evaluations when sampling. The published sampler has a schedule of 50 points
            and so 49 evaluations.

    Attributes:
        streams_as: how it samples frame by frame; None if it cannot.

    Raises:
        RecipeError: a value is out of its range.
    """

    trains = Denoiser
    weighs_frames = True
    streams_as: type[FlowStream[Any]] | None = None

    def __init__(
        self,
        *,
        shift: float = 5.0,
        prediction: Space = "velocity",
        loss_on: Space = "velocity",
        weighting: Literal["gaussian", "none"] = "gaussian",
        steps: int = 49,
    ) -> None:
        if not 0 < shift < math.inf:
            raise RecipeError(f"objective.shift={shift} must be positive and finite")
        if steps < 1:
            raise RecipeError(f"objective.steps={steps} must be at least 1")
        self.shift = shift
        self.prediction: Space = prediction
        self.loss_on: Space = loss_on
        self.steps = steps
        self._sigmas = shifted_schedule(TRAINING_POINTS, shift)
        self._weights = (
            gaussian_weights(self._sigmas)
            if weighting == "gaussian"
            else torch.ones_like(self._sigmas)
        )

    def loss(self, model: Denoiser, batch: Batch, known: int) -> Tensor:
        """The error of one evaluation at random noise levels; see `Objective.loss`."""
        evaluate = evaluation(model, batch.conditioning)
        return self.error(evaluate, batch.latents, batch.generators, known, batch.weights)

    def predict(
        self, model: Denoiser, given: Batch, frames: int, steps: int | None = None
    ) -> Latent:
        """Sample all frames together; see `Objective.predict`."""

        def evaluate(noisy: Latent, sigma: Sigmas) -> Latent:
            inputs = self.sampling_inputs(sigma, steps)
            return evaluation(model, given.conditioning, **inputs)(noisy, sigma)

        return self.sample(evaluate, given.noise(frames), given.latents, steps)

    def stream(
        self,
        model: Denoiser,
        given: Latent,
        generators: Sequence[torch.Generator],
        *,
        steps: int | None = None,
        context: int,
    ) -> LatentStream:
        """Sample frame by frame as `streams_as` does; see `Objective.stream`."""
        if self.streams_as is None:
            return super().stream(model, given, generators, steps=steps, context=context)
        return self.streams_as(self, model, given, generators, steps, context)

    def sampling_inputs(self, sigma: Sigmas, steps: int | None) -> dict[str, Tensor]:
        """The further inputs of an evaluation in `steps` sampling steps, at levels `[B, L]`."""
        return {}

    def draw(self, frames: int, generator: torch.Generator) -> Tensor:
        """Draw points of the training schedule for the `frames` latent frames after given ones."""
        return torch.randint(TRAINING_POINTS, (frames,), generator=generator)

    def error(
        self,
        evaluate: Evaluate,
        clean: Latent,
        generators: Sequence[torch.Generator],
        known: int = 1,
        weights: Tensor | None = None,
    ) -> Tensor:
        """Mean weighted squared error of one evaluation at random noise levels, a scalar.

        Args:
            evaluate: the network.
            clean: clean latents `[B, L, C, h, w]`, L > `known`.
            generators: one CPU generator per clip.
            known: number of first latent frames that are given.
            weights: of the latent frames, see `Batch.weights`.
        """
        frames = clean.shape[1] - known
        indices = torch.stack([self.draw(frames, generator) for generator in generators])
        noise = to_device(noise_of_clips(clean.shape[1:], generators), clean)
        sigma = to_device(torch.nn.functional.pad(self._sigmas[indices], (known, 0)), clean)
        noisy = mix(clean, noise, sigma)
        prediction = evaluate(noisy, sigma).float()
        if self.loss_on == "clean":
            error = self.to_clean(prediction, noisy, sigma) - clean
        else:
            error = self.to_velocity(prediction, noisy, sigma) - (noise - clean)
        per_frame = error[:, known:].square().flatten(2).mean(2)
        errors = per_frame * to_device(self._weights[indices], per_frame)
        return weighed(errors, weights).mean()

    def sample(
        self,
        evaluate: Evaluate,
        noise: Latent,
        given: Latent,
        steps: int | None = None,
    ) -> Latent:
        """Sample clean latents from noise with Euler steps; gradients pass through all of them.

        Args:
            evaluate: the network.
            noise: `[B, L, C, h, w]`; its first K frames are not used.
            given: the first K latent frames, clean, `[B, K, C, h, w]`; they stay fixed. K may be 0,
                for a network that keeps the past itself.
            steps: number of network evaluations along the shifted schedule, the same for all
                frames; the objective's `steps` by default.

        Returns:
            `[B, L, C, h, w]`; its first K frames are `given`.
        """
        known = given.shape[1]
        latents = torch.cat([given, noise[:, known:]], dim=1)
        batch, frames = latents.shape[:2]
        points = (steps or self.steps or 1) + 1
        levels = shifted_schedule(points, self.shift)[:, None].repeat(1, frames)
        levels[:, :known] = 0
        changes, levels = to_device(levels.diff(dim=0), latents), to_device(levels, latents)
        for now, change in zip(levels[:-1], changes, strict=True):
            sigma = now.expand(batch, frames)
            velocity = self.to_velocity(evaluate(latents, sigma).float(), latents, sigma)
            moved = latents + per_frame(change[None]) * velocity
            latents = torch.cat([given, moved[:, known:]], dim=1)
        return latents

    def to_velocity(self, prediction: Latent, noisy: Latent, sigma: Sigmas) -> Latent:
        """Convert a prediction at `noisy` to a velocity."""
        if self.prediction == "velocity":
            return prediction
        return (noisy - prediction) / per_frame(sigma.clamp(min=MIN_SIGMA))

    def to_clean(self, prediction: Latent, noisy: Latent, sigma: Sigmas) -> Latent:
        """Convert a prediction at `noisy` to a clean latent."""
        if self.prediction == "clean":
            return prediction
        return noisy - per_frame(sigma) * prediction


def evaluation(model: Denoiser, conditioning: Conditioning, **inputs: Tensor) -> Evaluate:
    """The network with everything that stays the same at all noise levels."""

    def evaluate(noisy: Latent, sigma: Sigmas) -> Latent:
        predicted = model(noisy, sigma, conditioning, **inputs)
        check_shape(model, "forward", predicted, *noisy.shape)
        return predicted

    return evaluate


def mix(clean: Latent, noise: Latent, sigma: Sigmas) -> Latent:
    """The noisy latent (1 − σ) · clean + σ · noise."""
    return torch.lerp(clean, noise, per_frame(sigma))


def per_frame(sigma: Sigmas) -> Tensor:
    """Values of latent frames `[B, L]`, to be multiplied with latents."""
    return sigma[:, :, None, None, None]
