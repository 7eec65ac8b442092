"""Diffusion forcing: one noise level per latent frame, so that a model can be streamed."""

from __future__ import annotations

import torch
from torch.nn import functional

from acwm_core.model.conditioner import Conditioning
from acwm_core.model.objectives.flow import FlowMatching, FlowStream
from acwm_core.model.shapes import Latent, Sigmas


class _DiffusionForcingStream(FlowStream["DiffusionForcing"]):
    """Samples latent frames one after the other, each with the cached past.

    A finished latent frame is evaluated once more, clean, so that later frames can attend to it.
    This is done in the same evaluation as the first one of the next frame.
    """

    def advance(self, conditioning: Conditioning) -> Latent:
        """Sample the next latent frame; see `LatentStream.advance`."""
        last, done, is_kept = self.last, self.last.shape[1], False
        alone = conditioning.frames(done, done + 1)

        def extend(noisy: Latent, sigma: Sigmas, actions: Conditioning) -> Latent:
            inputs = self.objective.sampling_inputs(sigma, self.steps)
            return self.model.extend(noisy, sigma, actions, self.cache, **inputs)

        def evaluate(noisy: Latent, sigma: Sigmas) -> Latent:
            nonlocal is_kept
            if is_kept:
                return extend(noisy, sigma, alone)
            pair = torch.cat([last, noisy], 1)
            predicted = extend(pair, functional.pad(sigma, (done, 0)), conditioning)
            self.cache.keep(done)
            is_kept = True
            return predicted[:, done:]

        noise = self.noise()
        self.last = self.objective.sample(evaluate, noise, noise[:, :0], self.steps)
        return self.last


class DiffusionForcing(FlowMatching):
    """Flow matching with one noise level per latent frame (Chen et al. 2024, arXiv 2407.01392).

    This is how the published code and checkpoints train. The past of a frame may be clean while the
    frame itself is noise, as streaming needs.
    """

    causal = True
    streams_as = _DiffusionForcingStream
