"""Diffusion forcing: one noise level per latent frame, so that a model can be streamed."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch.nn import functional

from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Cache, Denoiser, LatentStream
from acwm_core.model.objectives.flow import FlowMatching
from acwm_core.model.objectives.objective import drawn_noise
from acwm_core.model.shapes import Latent, Sigmas


class DiffusionForcing(FlowMatching):
    """Flow matching with one noise level per latent frame (Chen et al. 2024, arXiv 2407.01392).

    This is how the published code and checkpoints train. The past of a frame may be clean while the
    frame itself is noise, as streaming needs.
    """

    causal = True

    def stream(
        self,
        model: Denoiser,
        given: Latent,
        generators: Sequence[torch.Generator],
        *,
        steps: int | None = None,
        context: int,
    ) -> LatentStream:
        """Sample frame by frame with a cache; see `Objective.stream`."""
        return _DenoisedStream(self, model, given, generators, steps, model.new_cache(context))


class _DenoisedStream(LatentStream):
    """Samples latent frames one after the other, each with the cached past.

    A finished latent frame is evaluated once more, clean, so that later frames can attend to it.
    This is done in the same evaluation as the first one of the next frame.
    """

    def __init__(
        self,
        objective: FlowMatching,
        model: Denoiser,
        given: Latent,
        generators: Sequence[torch.Generator],
        steps: int | None,
        cache: Cache,
    ) -> None:
        self._objective, self._steps = objective, steps
        self._model, self._cache = model, cache
        self._generators = generators
        self._unkept: Latent | None = given
        self._shape = given.shape[2:]

    def advance(self, conditioning: Conditioning) -> Latent:
        """Sample the next latent frame; see `LatentStream.advance`."""
        assert self._unkept is not None
        done = self._unkept.shape[1]
        alone = conditioning.frames(done, done + 1)

        def extend(noisy: Latent, sigma: Sigmas, actions: Conditioning) -> Latent:
            inputs = self._objective.sampling_inputs(sigma, self._steps)
            return self._model.extend(noisy, sigma, actions, self._cache, **inputs)

        def evaluate(noisy: Latent, sigma: Sigmas) -> Latent:
            if self._unkept is None:
                return extend(noisy, sigma, alone)
            pair = torch.cat([self._unkept, noisy], 1)
            predicted = extend(pair, functional.pad(sigma, (done, 0)), conditioning)
            self._cache.keep(done)
            self._unkept = None
            return predicted[:, done:]

        noise = drawn_noise((1, *self._shape), self._generators).to(self._unkept)
        self._unkept = self._objective.sample(evaluate, noise, noise[:, :0], self._steps)
        return self._unkept
