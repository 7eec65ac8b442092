"""Next-frame flow matching: every latent frame is denoised after a clean past, in one pass.

Besides its own noisy latent, the network gets the previous frame for each latent frame. In a model
that is causal in time, a frame also sees the inputs of earlier frames, and so the whole clean past
but nothing of its own clean latent. A pass over a clip then costs as much as with diffusion
forcing; teacher forcing with clean and noisy copies of every frame costs twice that. Sampling goes
frame by frame, with the same inputs as training.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from acwm_core.errors import RecipeError
from acwm_core.model.batch import Batch, to_device
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Denoiser, InputKind
from acwm_core.model.objectives.flow import Evaluate, FlowMatching, FlowStream, evaluation, mix
from acwm_core.model.shapes import Latent, Sigmas


class _NextFrameStream(FlowStream["NextFrame"]):
    """Samples latent frames one after the other; each gets the previous frame as input.

    In the cache, later frames see a frame as it was evaluated last, still noisy, as in training.
    Its final latent is an input of the frame after it.
    """

    def advance(self, conditioning: Conditioning) -> Latent:
        """Sample the next latent frame; see `LatentStream.advance`."""
        done, last = self.last.shape[1], self.last[:, -1:]
        if not self.cache.frames:
            given, clean = self.last, self.last.new_zeros(self.last.shape[:2])
            self._extend(given, clean, conditioning.frames(0, done), frames_before(given))
            self.cache.keep(done)
        own = conditioning.frames(done, done + 1)

        def evaluate(noisy: Latent, sigma: Sigmas) -> Latent:
            return self._extend(noisy, sigma, own, last)

        noise = self.noise()
        after = self.objective.from_change(evaluate, last)
        self.last = self.objective.sample(after, noise, noise[:, :0], self.steps)
        self.cache.keep(1)
        return self.last

    def _extend(
        self, noisy: Latent, sigma: Sigmas, conditioning: Conditioning, previous: Latent
    ) -> Latent:
        clean = previous.new_zeros(previous.shape[:2])
        past = {"previous": previous, "previous_sigma": clean}
        return self.model.extend(noisy, sigma, conditioning, self.cache, **past)


class NextFrame(FlowMatching):
    """Flow matching of each latent frame, to which the network sees the frame before it.

    With `prediction=clean`, the network predicts the change from that frame, so an untrained model
    copies it.

    Args:
        past_noise: the largest noise level of the previous frame. The level is drawn for every
            frame and given to the network, so that it tolerates its own errors later.
        own_past: the share of clips that are trained after the model's own rollout instead of the
            true past (self-forcing, Huang et al. 2025, arXiv 2506.08009).
        **flow: see `FlowMatching`.

    Raises:
        RecipeError: a value is out of its range.
    """

    causal = True
    streams_as = _NextFrameStream
    inputs: Mapping[str, InputKind] = {"previous": "latent", "previous_sigma": "level"}

    def __init__(self, *, past_noise: float = 0.3, own_past: float = 0.0, **flow: Any) -> None:
        super().__init__(**flow)
        for name, share in (("past_noise", past_noise), ("own_past", own_past)):
            if not 0 <= share <= 1:
                raise RecipeError(f"objective.{name}={share} must be between 0 and 1")
        self.past_noise = past_noise
        self.own_past = own_past

    def loss(self, model: Denoiser, batch: Batch, known: int) -> Tensor:
        """The error of one evaluation after a past that is clean, noisy or the model's own."""
        latents, generators, frames = batch.latents, batch.generators, batch.latents.shape[1]
        past = self._past(model, batch, known)
        levels = torch.stack([torch.rand(frames, generator=generator) for generator in generators])
        noise = batch.noise(frames)
        sigma = to_device(levels * self.past_noise, latents)
        previous = mix(frames_before(past), noise, sigma)
        after = evaluation(model, batch.conditioning, previous=previous, previous_sigma=sigma)
        after_previous = self.from_change(after, previous)
        return self.error(after_previous, latents, generators, known, batch.weights)

    def _past(self, model: Denoiser, batch: Batch, known: int) -> Latent:
        """The clips, of which a share of `own_past` is the model's own rollout in one step."""
        latents = batch.latents
        if not self.own_past:
            return latents
        own = torch.stack([torch.rand((), generator=g) for g in batch.generators]) < self.own_past
        # Separate generators: whether there is a rollout depends on other clips of the batch.
        seeds = [int(torch.randint(2**62, (), generator=g)) for g in batch.generators]
        if not own.any():
            return latents
        noises = [torch.Generator().manual_seed(seed) for seed in seeds]
        given = Batch(latents[:, :known], batch.conditioning, noises)
        with torch.no_grad():
            rollout = self.predict(model, given, latents.shape[1], steps=1)
        return torch.where(to_device(own, latents)[:, None, None, None, None] > 0, rollout, latents)

    def predict(
        self, model: Denoiser, given: Batch, frames: int, steps: int | None = None
    ) -> Latent:
        """Sample a clip frame by frame; see `Objective.predict`."""
        latents, known = given.latents, given.latents.shape[1]
        context = max(frames, 2)
        stream = self.stream(model, latents, given.generators, steps=steps, context=context)
        clip = [latents]
        for frame in range(known, frames):
            start = 0 if frame == known else frame - 1
            clip.append(stream.advance(given.conditioning.frames(start, frame + 1)))
        return torch.cat(clip, 1)

    def streams_by_default(self, model: Denoiser) -> bool:
        """Always: a stream has the inputs of training."""
        return True

    def from_change(self, evaluate: Evaluate, previous: Latent) -> Evaluate:
        """The network's prediction: for clean latents, its output is added to the frame before."""
        if self.prediction == "velocity":
            return evaluate
        return lambda noisy, sigma: previous + evaluate(noisy, sigma)


def frames_before(latents: Latent) -> Latent:
    """The previous frame of each frame `[B, L, C, h, w]`; for the first frame, itself."""
    return torch.cat([latents[:, :1], latents[:, :-1]], 1)
