"""`check_model`: the contract of every dynamics model, and what flows require of a denoiser."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from acwm_core.checks.dynamics import DynamicsChecks, Probe
from acwm_core.checks.result import CheckResult, Suite, expect, expect_equal, run_checks
from acwm_core.checks.trial import batch_error, noise, shaken
from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.denoiser import Denoiser
from acwm_core.model.dynamics import Cache, DynamicsModel

CHANNELS = 4


def check_model(model: str | Callable[..., DynamicsModel], **params: Any) -> Iterator[CheckResult]:
    """Check a model against the contract of `acwm_core.model.dynamics.DynamicsModel`.

    A denoiser is also checked against the contract of `acwm_core.model.denoiser.Denoiser`.

    Weights are perturbed first: many models start with zero layers, which would hide their inputs.

    Args:
        model: a registered name, or the class.
        **params: constructor parameters, for instance a small width; not `latent_channels`.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: the name cannot be resolved.
    """
    checks = DynamicsChecks(model, **params)
    yield from run_checks(checks)
    if checks.is_denoiser:
        yield from DenoiserChecks.check(model, **params)


class DenoiserChecks(Suite):
    """Checks of a denoiser on random latents."""

    kind = "model"

    @functools.cached_property
    def _model(self) -> Denoiser:
        return shaken(self.make(latent_channels=CHANNELS)).eval()

    def _conditioning(self, batch: int, frames: int, seed: int = 3) -> Conditioning:
        modulation = noise((batch, frames, self._model.width), seed)
        return Conditioning(modulation, None, Probe(("input", *range(self._model.layers))))

    def _inputs(
        self, batch: int = 1, frames: int = 3, height: int = 8, width: int = 8
    ) -> tuple[Tensor, Tensor, Conditioning]:
        """Random latents, noise levels (0 for the first frame) and conditioning."""
        sigma = torch.linspace(0, 0.9, frames).repeat(batch, 1)
        latents = noise((batch, frames, CHANNELS, height, width), seed=1)
        return latents, sigma, self._conditioning(batch, frames)

    @torch.no_grad()
    def _run(self, latents: Tensor, sigma: Tensor, conditioning: Conditioning) -> Tensor:
        return self._model(latents, sigma, conditioning)

    @torch.no_grad()
    def _extend(
        self, cache: Cache, inputs: tuple[Tensor, Tensor, Conditioning], start: int, stop: int
    ) -> Tensor:
        latents, sigma, conditioning = inputs
        rows = slice(start, stop)
        frames = conditioning.frames(start, stop)
        return self._model.extend(latents[:, rows], sigma[:, rows], frames, cache)

    def keeps_the_shape(self) -> None:
        """Return finite predictions of the latents' shape, for any length and size."""
        for size in ((1, 1, 8, 8), (2, 3, 8, 12), (1, 5, 16, 8)):  # B, L, h, w
            latents, sigma, conditioning = self._inputs(*size)
            predicted = self._run(latents, sigma, conditioning)
            shapes = list(latents.shape), list(predicted.shape)
            expect(shapes[0] == shapes[1], f"latents {shapes[0]} give a prediction {shapes[1]}")
            expect(predicted.isfinite().all(), "the prediction is not finite")

    def sees_latents_and_noise_level(self) -> None:
        """Let the prediction depend on every latent frame and its noise level."""
        latents, sigma, conditioning = self._inputs()
        usual = self._run(latents, sigma, conditioning)
        for frame in range(latents.shape[1]):
            other, noisier = _changed(latents, sigma, frame)
            for name, inputs in (("latents", (other, sigma)), ("noise level", (latents, noisier))):
                changed = self._run(*inputs, conditioning)
                same = torch.equal(usual[:, frame], changed[:, frame])
                expect(not same, f"its prediction of a frame ignores the frame's {name}")

    def sees_the_frame_before_if_it_says_so(self) -> None:
        """With `previous` true, depend on the previous frame and its noise level."""
        latents, sigma, conditioning = self._inputs()
        after = replace(conditioning, previous=-latents, previous_sigma=sigma / 2)
        usual = self._run(latents, sigma, after)
        other, noisier = replace(after, previous=latents), replace(after, previous_sigma=sigma)
        for what, inputs in (("latents", other), ("noise level", noisier)):
            same = torch.equal(usual, self._run(latents, sigma, inputs))
            expect(not (same and self._model.previous), f"it ignores the {what} of the one before")

    def is_causal_if_it_says_so(self) -> None:
        """With `causal` true, predict a frame independently of later ones."""
        latents, sigma, conditioning = self._inputs(frames=4)
        usual = self._run(latents, sigma, conditioning)
        for frame in range(1, latents.shape[1]) if self._model.causal else ():
            changed = self._run(*_changed(latents, sigma, frame), conditioning)
            error = batch_error(usual[:, :frame], changed[:, :frame])
            what = f"what it predicts before latent frame {frame} depends on that frame"
            expect(error < 1e-4, what)

    def frame_by_frame_it_predicts_the_same(self) -> None:
        """With a cache, predict the same as for all frames at once, in and beyond the context."""
        model, inputs = self._model, self._inputs(batch=2, frames=6)
        if type(model).new_cache is Denoiser.new_cache:
            return
        try:
            model.new_cache(2)
        except RecipeError:
            expect(not model.causal, "it is causal and has a cache, but refuses to make one")
            return
        beyond = self._extend(model.new_cache(3), inputs, 0, 6)
        negative = (-inputs[0], *inputs[1:])
        for context, expected in ((6, self._run(*inputs)), (3, beyond)):
            cache = model.new_cache(context)
            for start, stop in ((0, 1), (1, 3), (3, 4), (4, 6)):
                # Frames evaluated but not kept must leave no trace: streams need this in each step.
                self._extend(cache, negative, start, stop)
                predicted = self._extend(cache, inputs, start, stop)
                cache.keep(stop - start)
                error = batch_error(expected[:, start:stop], predicted)
                expect(error < 1e-4, f"cached and uncached differ by {error:.2g} at frame {start}")

    def uses_the_modulation(self) -> None:
        """Depend on the conditioner's modulation of each frame, and also work without one."""
        latents, sigma, conditioning = self._inputs()
        other = self._conditioning(*latents.shape[:2], seed=4)
        usual, changed = (self._run(latents, sigma, c) for c in (conditioning, other))
        for frame in range(latents.shape[1]):
            same = torch.equal(usual[:, frame], changed[:, frame])
            expect(not same, f"the modulation of latent frame {frame} has no effect")
        self._run(latents, sigma, Conditioning(None, None, Probe()))

    def calls_the_conditioner_once_in_order(self) -> None:
        """Call `inject_input`, then `inject` for each layer, once per evaluation."""
        latents, sigma, _ = self._inputs()
        probe, layers = Probe(), self._model.layers
        self._run(latents, sigma, Conditioning(None, None, probe))
        wanted = ["input", *range(layers)] if layers else []
        expect_equal("the conditioner is called at", [place for place, _ in probe.called], wanted)


def _changed(latents: Tensor, sigma: Tensor, frame: int) -> tuple[Tensor, Tensor]:
    other, noisier = latents.clone(), sigma.clone()
    other[:, frame] += 1
    noisier[:, frame] += 0.1
    return other, noisier
