"""Shortcut forcing: the network learns to take long sampling steps (arXiv 2410.12557, 2509.24527).

Beside the noise level, the network gets the size of the step that will be taken with its output. A
step of size 0 is flow matching: the output is compared with the clean latent. A longer step has to
end where two steps of half its size end, which the network takes itself, without gradients. So what
the shortest steps learn from data reaches the longest ones.

Noise levels and steps are those of single latent frames, as in diffusion forcing. Steps are
measured on the uniform grid from 0 (clean) to 1 (noise) that `shift` maps to noise levels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from acwm_core.errors import RecipeError
from acwm_core.model.batch import Batch, to_device, weighed
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Denoiser, InputKind
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.objectives.flow import MIN_SIGMA, evaluation, mix, per_frame
from acwm_core.model.shapes import Latent, Sigmas


class ShortcutForcing(DiffusionForcing):
    """Flow matching that also learns steps of 1, 1/2, 1/4, … of the way from noise to data.

    The network predicts clean latents, in which its errors are measured.

    Args:
        shift: shifts the noise levels towards noise, see `FlowMatching`; Dreamer 4 uses 1.
        ramp: whether to weigh errors by 0.1 + 0.9 (1 − σ), as Dreamer 4 does: where little noise is
            left, there is more to learn.
        steps: network evaluations when sampling, a power of two.
        finest: number of the shortest steps on the whole way, a power of two.
        bootstrapped: share of clips that learn long steps; the others learn from data alone. It
            costs two more evaluations of these clips, without gradients.

    Raises:
        RecipeError: a value is out of its range.
    """

    inputs: Mapping[str, InputKind] = {"step": "level"}

    def __init__(
        self,
        *,
        shift: float = 1.0,
        ramp: bool = True,
        steps: int = 4,
        finest: int = 64,
        bootstrapped: float = 0.25,
    ) -> None:
        super().__init__(
            shift=shift, prediction="clean", loss_on="clean", weighting="none", steps=steps
        )
        if finest < 1 or finest & (finest - 1):
            raise RecipeError(f"objective.finest={finest} must be a power of two")
        if not 0 <= bootstrapped <= 1:
            raise RecipeError(f"objective.bootstrapped={bootstrapped} must be between 0 and 1")
        self.ramp = ramp
        self.finest = finest
        self.bootstrapped = bootstrapped

    def loss(self, model: Denoiser, batch: Batch, known: int) -> Tensor:
        """Squared error of one evaluation with random noise levels and steps."""
        latents, conditioning = batch.latents, batch.conditioning
        frames = latents.shape[1] - known
        drawn = [self.draw_steps(frames, generator) for generator in batch.generators]
        places, steps = (
            functional.pad(torch.stack(each), (known, 0)) for each in zip(*drawn, strict=True)
        )
        place, step = to_device(places, latents), to_device(steps, latents)
        sigma = self.level(place)
        noisy = mix(latents, batch.noise(latents.shape[1]), sigma)
        target = latents.clone()
        # Chosen on the CPU, so that nothing waits for an accelerator.
        chosen = steps.any(1).nonzero().flatten()
        if len(chosen):
            long = to_device(chosen, latents, torch.long)
            own = of_clips(conditioning, long)
            found = self.target(model, own, noisy[long], place[long], step[long])
            with_step = per_frame(step[long]) > 0
            target[long] = torch.where(with_step, found.to(target), target[long])
        predicted = evaluation(model, conditioning, step=step)(noisy, sigma).float()
        error = (predicted - target)[:, known:].square().flatten(2).mean(2)
        error = error * (1 - 0.9 * sigma[:, known:]) if self.ramp else error
        return weighed(error, batch.weights).mean()

    def draw_steps(self, frames: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw places on the way, in (0, 1], and steps of a clip's frames, each `[frames]`.

        A step is 0, or a power of two of which the place is a multiple.
        """
        sizes = torch.tensor([0.0, *(2.0**-k for k in range(int(math.log2(self.finest)) + 1))])
        long = torch.rand((), generator=generator) < self.bootstrapped
        step = sizes[torch.randint(len(sizes), (frames,), generator=generator)] * long
        place = torch.rand(frames, generator=generator)
        upper = step * (place / step.clamp(min=2.0**-20)).floor() + step
        return torch.where(step > 0, upper, place), step

    def level(self, place: Tensor) -> Sigmas:
        """Noise levels of places on the way from data (0) to noise (1)."""
        return self.shift * place / (1 + (self.shift - 1) * place)

    @torch.no_grad()
    def target(
        self,
        model: Denoiser,
        conditioning: Conditioning,
        noisy: Latent,
        place: Tensor,
        step: Tensor,
    ) -> Latent:
        """The clean latents to predict so that a step ends where two half steps end.

        Args:
            model: takes the half steps.
            conditioning: of these clips.
            noisy: latents `[B, L, C, h, w]`.
            place: where they are on the way, `[B, L]`.
            step: sizes of the steps, `[B, L]`; where it is 0, the result has no meaning.
        """
        half = step / 2
        told = torch.where(half * self.finest < 1, 0, half)  # the shortest are flow matching
        moved = noisy
        for start in (place, place - half):
            sigma, change = self.level(start), self.level(start) - self.level(start - half)
            clean = evaluation(model, conditioning, step=told)(moved, sigma).float()
            moved = moved - per_frame(change) * self.to_velocity(clean, moved, sigma)
        sigma = self.level(place)
        way = (sigma - self.level(place - step)).clamp(min=MIN_SIGMA)
        return noisy - per_frame(sigma / way) * (noisy - moved)

    def sampling_inputs(self, sigma: Sigmas, steps: int | None) -> dict[str, Tensor]:
        """The size of the sampling steps; 0 for what is clean."""
        size = 1 / min(steps or self.steps or 1, self.finest)
        return {"step": torch.where(sigma > 0, size, 0).to(sigma)}


def of_clips(conditioning: Conditioning, chosen: Tensor) -> Conditioning:
    """The conditioning of some clips of a batch."""
    modulation, context = (
        None if part is None else part[chosen]
        for part in (conditioning.modulation, conditioning.context)
    )
    return replace(conditioning, modulation=modulation, context=context)
