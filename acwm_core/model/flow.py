"""Flow matching on latents: noise path, shifted schedule, objectives and Euler sampler.

The path is the straight line x_σ = (1 − σ) · x + σ · ε between a clean latent x and noise ε
(Lipman et al. 2023; Liu et al. 2023); its velocity is ε − x. The first latent frames are given:
they stay clean (σ = 0) and have no loss. Everything here works on tensors; the network is passed in
as a function.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.shapes import Latent, Sigmas

TRAINING_POINTS = 1000
"""Number of points of the schedule that training draws from (the published value)."""

MIN_SIGMA = 1e-3
"""Smallest noise level by which to divide when a clean latent is converted to a velocity."""

Objective = Literal["full_sequence", "diffusion_forcing", "next_frame"]
"""How training draws noise levels: per clip, per latent frame, or per frame after a clean past."""

Space = Literal["velocity", "clean"]

Denoiser = Callable[[Latent, Sigmas], Latent]
"""A network evaluation: maps noisy latents and noise levels to the flow's prediction."""


def drawn_noise(shape: Sequence[int], generators: Sequence[torch.Generator]) -> Tensor:
    """Standard normal noise `[B, *shape]` on the CPU; each clip has its own generator."""
    return torch.stack([torch.randn(tuple(shape), generator=each) for each in generators])


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


class Flow:
    """Defines what the network predicts, its noise levels in training, and the sampler.

    Args:
        objective: `full_sequence` draws one noise level per clip in training, as in the paper.
            `diffusion_forcing` draws one per latent frame (Chen et al. 2024, arXiv 2407.01392), as
            in the published code and checkpoints, for a model that is causal in time. Then the past
            of a frame may be clean while the frame itself is noise, as streaming needs.
            `next_frame` also shows each latent frame the previous one, clean except for
            `past_noise`; it is sampled frame by frame (`acwm_core.model.next_frame`).
        shift: shifts the schedule towards noise, for training and sampling. The paper uses 5. At
            small scale, models learned actions with 20 but not with 5, because slightly noisy
            latents still show where things move.
        prediction: what the network predicts, the velocity or the clean latent.
        loss_on: the space in which the squared error is computed.
        weighting: `gaussian` is the published weight over noise levels; `none` weighs all equally.
        steps: network evaluations when sampling. The published sampler has a schedule of 50 points
            and so 49 evaluations.
        past_noise: with `next_frame`, the largest noise level of the previous frame. The level is
            drawn for every frame and given to the network, so that it tolerates its own errors
            later.
        own_past: with `next_frame`, the share of clips that are trained after the model's own
            rollout instead of the true past (self-forcing, Huang et al. 2025, arXiv 2506.08009).

    Raises:
        RecipeError: a value is out of its range, or the objective does not use it.
    """

    def __init__(
        self,
        *,
        objective: Objective = "full_sequence",
        shift: float = 5.0,
        prediction: Space = "velocity",
        loss_on: Space = "velocity",
        weighting: Literal["gaussian", "none"] = "gaussian",
        steps: int = 49,
        past_noise: float = 0.3,
        own_past: float = 0.0,
    ) -> None:
        for name, share in (("past_noise", past_noise), ("own_past", own_past)):
            if not 0 <= share <= 1:
                raise RecipeError(f"flow.{name}={share} must be between 0 and 1")
        if own_past and objective != "next_frame":
            raise RecipeError("flow.own_past needs flow.objective=next_frame")
        if not 0 < shift < math.inf:
            raise RecipeError(f"flow.shift={shift} must be positive and finite")
        if steps < 1:
            raise RecipeError(f"flow.steps={steps} must be at least 1")
        self.objective: Objective = objective
        self.shift = shift
        self.prediction: Space = prediction
        self.loss_on: Space = loss_on
        self.weighting = weighting
        self.steps = steps
        self.past_noise = past_noise
        self.own_past = own_past
        self._sigmas = shifted_schedule(TRAINING_POINTS, shift)
        self._weights = (
            gaussian_weights(self._sigmas)
            if weighting == "gaussian"
            else torch.ones_like(self._sigmas)
        )

    def loss(
        self,
        denoise: Denoiser,
        clean: Latent,
        generators: Sequence[torch.Generator],
        known: int = 1,
    ) -> Tensor:
        """Mean weighted squared error of one evaluation at random noise levels.

        Args:
            denoise: the network.
            clean: clean latents `[B, L, C, h, w]`, L > `known`.
            generators: one CPU generator per clip, so that the random numbers of a clip depend
                neither on the other clips of the batch nor on the device.
            known: number of first latent frames that are given.

        Returns:
            A scalar.
        """
        frames = clean.shape[1] - known
        drawn = torch.stack([self._draw(frames, generator) for generator in generators])
        noise = drawn_noise(clean.shape[1:], generators).to(clean)
        sigma = torch.nn.functional.pad(self._sigmas[drawn], (known, 0)).to(clean)
        noisy = mix(clean, noise, sigma)
        prediction = denoise(noisy, sigma).float()
        if prediction.shape != noisy.shape:  # broadcasting would hide it
            shapes = f"{tuple(prediction.shape)} for latents of {tuple(noisy.shape)}"
            raise ShapeError(f"the model returns {shapes}: it has to keep their shape")
        if self.loss_on == "clean":
            error = self.to_clean(prediction, noisy, sigma) - clean
        else:
            error = self.to_velocity(prediction, noisy, sigma) - (noise - clean)
        per_frame = error[:, known:].square().flatten(2).mean(2)
        return (per_frame * self._weights[drawn].to(per_frame)).mean()

    def _draw(self, frames: int, generator: torch.Generator) -> Tensor:
        """Draw points of the training schedule for `frames` latent frames after the given ones."""
        levels = 1 if self.objective == "full_sequence" else frames
        return torch.randint(TRAINING_POINTS, (levels,), generator=generator).expand(frames)

    def sample(
        self,
        denoise: Denoiser,
        noise: Latent,
        given: Latent,
        steps: int | None = None,
    ) -> Latent:
        """Sample clean latents from noise with Euler steps; gradients pass through all of them.

        Args:
            denoise: the network.
            noise: `[B, L, C, h, w]`; its first K frames are not used.
            given: the first K latent frames, clean, `[B, K, C, h, w]`; they stay fixed. K may be 0,
                for a network that keeps the past itself.
            steps: number of network evaluations along the shifted schedule, the same for all
                frames; the flow's `steps` by default.

        Returns:
            `[B, L, C, h, w]`; its first K frames are `given`.
        """
        known = given.shape[1]
        latents = torch.cat([given, noise[:, known:]], dim=1)
        batch, frames = latents.shape[:2]
        points = (steps or self.steps) + 1
        levels = shifted_schedule(points, self.shift)[:, None].repeat(1, frames)
        levels[:, :known] = 0
        changes = levels.diff(dim=0).to(latents.dtype).to(latents.device)
        levels = levels.to(latents.dtype).to(latents.device)
        for now, change in zip(levels[:-1], changes, strict=True):
            sigma = now.expand(batch, frames)
            velocity = self.to_velocity(denoise(latents, sigma).float(), latents, sigma)
            moved = latents + _per_frame(change[None]) * velocity
            latents = torch.cat([given, moved[:, known:]], dim=1)
        return latents

    def to_velocity(self, prediction: Latent, noisy: Latent, sigma: Sigmas) -> Latent:
        """Convert a prediction at `noisy` to a velocity."""
        if self.prediction == "velocity":
            return prediction
        return (noisy - prediction) / _per_frame(sigma.clamp(min=MIN_SIGMA))

    def to_clean(self, prediction: Latent, noisy: Latent, sigma: Sigmas) -> Latent:
        """Convert a prediction at `noisy` to a clean latent."""
        if self.prediction == "clean":
            return prediction
        return noisy - _per_frame(sigma) * prediction


def mix(clean: Latent, noise: Latent, sigma: Sigmas) -> Latent:
    """The noisy latent (1 − σ) · clean + σ · noise."""
    return torch.lerp(clean, noise, _per_frame(sigma))


def _per_frame(sigma: Sigmas) -> Tensor:
    return sigma[:, :, None, None, None]
