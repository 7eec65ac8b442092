"""Flow matching on latents: noise path, shifted schedule, loss and Euler sampler (pure tensors).

The path is the straight line x_σ = (1 − σ) · x + σ · ε between a clean latent x and noise ε
(Lipman et al. 2023; Liu et al. 2023); its velocity is ε − x. The first latent frame is the given
one: it stays clean (σ = 0) and carries no loss.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

from acwm_core.errors import RecipeError
from acwm_core.shapes import Latent, Sigmas

TRAINING_POINTS = 1000
"""Points of the schedule that training draws from (the published value)."""

MIN_SIGMA = 1e-3
"""Below this noise level a velocity cannot be told from a clean latent by division."""

Space = Literal["velocity", "clean"]

Denoiser = Callable[[Latent, Sigmas], Latent]
"""A network evaluation: noisy latents and noise levels to the flow's prediction."""


def shifted_schedule(points: int, shift: float) -> Tensor:
    """Noise levels from 1 to 0, `[points]` float64, bent towards noise by `shift`.

    σ' = s·σ / (1 + (s − 1)·σ) on a uniform grid (Esser et al. 2024, eq. 23); 1 leaves it uniform.
    """
    sigma = torch.linspace(1, 0, points, dtype=torch.float64)
    return shift * sigma / (1 + (shift - 1) * sigma)


def gaussian_weights(sigma: Tensor) -> Tensor:
    """Published loss weights: a Gaussian centred on σ = 0.5, lowered to touch 0, of mean 1.

    exp(−2 ((1000σ − 500) / 1000)²) minus its minimum over the schedule (arXiv 2605.08567,
    appendix on flow matching). It vanishes at both ends of the schedule.
    """
    weights = torch.exp(-2 * (sigma - 0.5) ** 2)
    weights = weights - weights.min()
    return weights / weights.mean()


class Flow:
    """What is predicted, at which noise levels it is learned, and how it is sampled.

    Args:
        shift: bends the schedule towards noise, for training and sampling. The paper uses 5; at
            small scale 20 learned actions that 5 did not, because a little noise still shows where
            things go.
        prediction: what the network's output means, the velocity or the clean latent.
        loss_on: the space in which the squared error is taken.
        weighting: `gaussian` is the published weight over noise levels, `none` weighs all alike.
        steps: network evaluations when sampling. The published sampler has a schedule of 50 points
            and so 49 evaluations.
    """

    def __init__(
        self,
        *,
        shift: float = 5.0,
        prediction: Space = "velocity",
        loss_on: Space = "velocity",
        weighting: Literal["gaussian", "none"] = "gaussian",
        steps: int = 49,
    ) -> None:
        if shift <= 0:
            raise RecipeError(f"flow.shift={shift} must be positive")
        if steps < 1:
            raise RecipeError(f"flow.steps={steps} must be at least 1")
        self.shift = shift
        self.prediction: Space = prediction
        self.loss_on: Space = loss_on
        self.weighting = weighting
        self.steps = steps
        self._sigmas = shifted_schedule(TRAINING_POINTS, shift)
        self._weights = (
            gaussian_weights(self._sigmas)
            if weighting == "gaussian"
            else torch.ones_like(self._sigmas)
        )

    def loss(self, denoise: Denoiser, clean: Latent, generator: torch.Generator) -> Tensor:
        """Mean weighted squared error of one evaluation at a random noise level per clip.

        Args:
            denoise: the network.
            clean: clean latents `[B, L, C, h, w]`, L ≥ 2.
            generator: CPU generator; the same state gives the same loss on any device.

        Returns:
            A scalar.
        """
        batch = clean.shape[0]
        index = torch.randint(TRAINING_POINTS, (batch,), generator=generator)
        noise = torch.randn(clean.shape, generator=generator).to(clean)
        sigma = frame_sigmas(self._sigmas[index].to(clean), clean.shape[1])
        noisy = mix(clean, noise, sigma)
        prediction = denoise(noisy, sigma).float()
        if self.loss_on == "clean":
            error = self.to_clean(prediction, noisy, sigma) - clean
        else:
            error = self.to_velocity(prediction, noisy, sigma) - (noise - clean)
        per_clip = error[:, 1:].square().flatten(1).mean(1)
        return (per_clip * self._weights[index].to(per_clip)).mean()

    @torch.no_grad()
    def sample(self, denoise: Denoiser, noise: Latent, first: Latent, steps: int) -> Latent:
        """Euler steps from noise to clean latents along the shifted schedule.

        Args:
            denoise: the network.
            noise: `[B, L, C, h, w]`; its first frame is not used.
            first: the clean first latent frame `[B, 1, C, h, w]`.
            steps: network evaluations, at least 1.
        """
        schedule = [float(level) for level in shifted_schedule(steps + 1, self.shift)]
        latents = torch.cat([first, noise[:, 1:]], dim=1)
        batch, frames = latents.shape[:2]
        for level, next_level in pairwise(schedule):
            sigma = frame_sigmas(latents.new_full((batch,), level), frames)
            prediction = denoise(latents, sigma).float()
            velocity = self.to_velocity(prediction, latents, sigma)
            future = latents[:, 1:] + (next_level - level) * velocity[:, 1:]
            latents = torch.cat([first, future], dim=1)
        return latents

    def to_velocity(self, prediction: Latent, noisy: Latent, sigma: Sigmas) -> Latent:
        """The velocity that a prediction at `noisy` means."""
        if self.prediction == "velocity":
            return prediction
        return (noisy - prediction) / _per_frame(sigma.clamp(min=MIN_SIGMA))

    def to_clean(self, prediction: Latent, noisy: Latent, sigma: Sigmas) -> Latent:
        """The clean latent that a prediction at `noisy` means."""
        if self.prediction == "clean":
            return prediction
        return noisy - _per_frame(sigma) * prediction


def mix(clean: Latent, noise: Latent, sigma: Sigmas) -> Latent:
    """The noisy latent (1 − σ) · clean + σ · noise."""
    return torch.lerp(clean, noise, _per_frame(sigma))


def frame_sigmas(level: Tensor, frames: int) -> Sigmas:
    """One noise level per clip `[B]` spread to `[B, frames]`, with a clean first frame."""
    sigma = level[:, None].repeat(1, frames)
    sigma[:, 0] = 0
    return sigma


def _per_frame(sigma: Sigmas) -> Tensor:
    return sigma[:, :, None, None, None]
