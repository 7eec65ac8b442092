"""`flow.objective=next_frame`: every latent frame is denoised after a clean past, in one pass.

Besides its own noisy latent, the network gets the previous frame for each latent frame. In a model
that is causal in time, a frame also sees the inputs of earlier frames, and so the whole clean past
but nothing of its own clean latent. A pass over a clip then costs as much as with diffusion
forcing; teacher forcing with clean and noisy copies of every frame costs twice that. Sampling goes
frame by frame, with the same inputs as training.

With `flow.prediction=clean`, the network predicts the change from the previous frame, so an
untrained model copies that frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Cache, LatentStream
from acwm_core.model.flow import Flow, drawn_noise, mix
from acwm_core.model.shapes import Latent, Sigmas


class Extendable(Protocol):
    """The parts of a denoiser that are used here; see `acwm_core.model.denoiser.Denoiser`."""

    flow: Flow
    given_frames: int

    def __call__(self, latents: Latent, sigma: Sigmas, conditioning: Conditioning) -> Latent:
        """Evaluate a clip once."""
        ...

    def new_cache(self, context: int) -> Cache:
        """Create an empty cache for `extend`."""
        ...

    def extend(
        self, latents: Latent, sigma: Sigmas, conditioning: Conditioning, cache: Cache
    ) -> Latent:
        """Evaluate the frames after those in the cache once."""
        ...


def loss(
    model: Extendable,
    latents: Latent,
    conditioning: Conditioning,
    generators: Sequence[torch.Generator],
) -> Tensor:
    """The flow's loss for one evaluation after a past that is clean, noisy or the model's own.

    Arguments and result are those of `DynamicsModel.loss`.
    """
    flow, frames = model.flow, latents.shape[1]
    past = latents
    if flow.own_past:
        own = torch.stack([torch.rand((), generator=g) for g in generators]) < flow.own_past
        # Separate generators: whether there is a rollout depends on other clips of the batch.
        seeds = [int(torch.randint(2**62, (), generator=g)) for g in generators]
        noises = [torch.Generator().manual_seed(seed) for seed in seeds]
        if own.any():
            given = latents[:, : model.given_frames]
            with torch.no_grad():
                rollout = predict(model, given, conditioning, frames, noises, steps=1)
            past = torch.where(own.to(latents.device)[:, None, None, None, None], rollout, latents)
    levels = torch.stack([torch.rand(frames, generator=g) for g in generators])
    noise = drawn_noise(latents.shape[1:], generators).to(latents)
    sigma = (levels * flow.past_noise).to(latents)
    after = replace(conditioning, previous=mix(_before(past), noise, sigma), previous_sigma=sigma)

    def denoise(noisy: Latent, level: Sigmas) -> Latent:
        return _predicted(model, model(noisy, level, after), after)

    return flow.loss(denoise, latents, generators, model.given_frames)


def predict(
    model: Extendable,
    given: Latent,
    conditioning: Conditioning,
    frames: int,
    generators: Sequence[torch.Generator],
    steps: int | None = None,
) -> Latent:
    """Sample a clip frame by frame; see `DynamicsModel.predict`."""
    known = given.shape[1]
    cache = model.new_cache(max(frames, 2))
    stream = NextFrameStream(model, given, generators, steps, cache)
    clip = [given]
    for frame in range(known, frames):
        start = 0 if frame == known else frame - 1
        clip.append(stream.advance(conditioning.frames(start, frame + 1)))
    return torch.cat(clip, 1)


class NextFrameStream(LatentStream):
    """Samples latent frames one after the other; each gets the previous frame as input.

    In the cache, later frames see a frame as it was evaluated last, still noisy, as in training.
    Its final latent is an input of the frame after it.
    """

    def __init__(
        self,
        model: Extendable,
        given: Latent,
        generators: Sequence[torch.Generator],
        steps: int | None,
        cache: Cache,
    ) -> None:
        self._model, self._cache, self._steps = model, cache, steps
        self._generators = generators
        self._last = given

    def advance(self, conditioning: Conditioning) -> Latent:
        """Sample the next latent frame; see `LatentStream.advance`."""
        done, last = self._last.shape[1], self._last[:, -1:]
        if not self._cache.frames:
            given = self._last
            after = _after(_before(given), conditioning.frames(0, done))
            self._model.extend(given, given.new_zeros(given.shape[:2]), after, self._cache)
            self._cache.keep(done)
        after = _after(last, conditioning.frames(done, done + 1))

        def denoise(noisy: Latent, sigma: Sigmas) -> Latent:
            made = self._model.extend(noisy, sigma, after, self._cache)
            return _predicted(self._model, made, after)

        noise = drawn_noise(last.shape[1:], self._generators).to(last)
        self._last = self._model.flow.sample(denoise, noise, noise[:, :0], self._steps)
        self._cache.keep(1)
        return self._last


def _before(latents: Latent) -> Latent:
    """The previous frame of each frame; for the first frame, itself."""
    return torch.cat([latents[:, :1], latents[:, :-1]], 1)


def _after(previous: Latent, conditioning: Conditioning) -> Conditioning:
    """`conditioning` with clean `previous` frames."""
    clean = previous.new_zeros(previous.shape[:2])
    return replace(conditioning, previous=previous, previous_sigma=clean)


def _predicted(model: Extendable, output: Latent, after: Conditioning) -> Latent:
    """Convert the network's output to a prediction: for clean latents, add the previous frame."""
    assert after.previous is not None
    return after.previous + output if model.flow.prediction == "clean" else output
