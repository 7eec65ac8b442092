"""`check_model`: what flows and conditioners rely on in a model, above all in a denoiser."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from acwm_core.checks.dynamics import DYNAMICS_CHECKS, DynamicsTrial
from acwm_core.checks.result import CheckResult, expect, expect_is_a, factory, run_checks
from acwm_core.checks.weights import batch_error, shaken, without_gradient
from acwm_core.conditioner import Conditioner, Conditioning
from acwm_core.denoiser import Cache, Denoiser
from acwm_core.dynamics import DynamicsModel
from acwm_core.errors import RecipeError
from acwm_core.shapes import Actions, Tokens

CHANNELS = 4
SIZES = ((1, 1, 8, 8), (2, 3, 8, 12), (1, 5, 16, 8))
"""B, L, h, w of the latents that are tried."""


class Probe(Conditioner):
    """Records the layers it is called for and adds `offset` to the tokens after the last."""

    def __init__(self, layers: int, offset: Tensor | None = None) -> None:
        super().__init__()
        self.layers = layers
        self.offset = offset
        self.called: list[int] = []

    def forward(self, actions: Actions) -> Conditioning:
        """A conditioning without content; `actions` are not looked at."""
        return Conditioning(None, None, self)

    def inject(self, layer: int, tokens: Tokens, conditioning: Conditioning) -> Tokens:
        """Record the call."""
        self.called.append(layer)
        if self.offset is not None and layer == self.layers - 1:
            return tokens + self.offset
        return tokens


class ModelTrial:
    """A denoiser whose zero-initialised layers were shaken awake, and inputs for it.

    Args:
        make: constructs the model; takes `latent_channels`.
    """

    def __init__(self, make: Callable[..., Denoiser]) -> None:
        self.make = make

    @functools.cached_property
    def model(self) -> Denoiser:
        """One instance."""
        return shaken(self.make(latent_channels=CHANNELS)).eval()

    def conditioning(self, batch: int, frames: int, seed: int = 3) -> Conditioning:
        """Random modulation from a probe."""
        modulation = _noise((batch, frames, self.model.width), seed)
        return Conditioning(modulation, None, Probe(self.model.layers))

    def run(self, latents: Tensor, sigma: Tensor, conditioning: Conditioning) -> Tensor:
        """Evaluate without gradients."""
        with torch.no_grad():
            return self.model(latents, sigma, conditioning)

    def extend(
        self,
        cache: Cache,
        latents: Tensor,
        sigma: Tensor,
        conditioning: Conditioning,
        start: int = 0,
        stop: int = 10**9,
    ) -> Tensor:
        """Evaluate frames `start` to `stop` after those in the cache, without gradients."""
        part = latents[:, start:stop], sigma[:, start:stop], conditioning.frames(start, stop)
        with torch.no_grad():
            return self.model.extend(*part, cache)

    def inputs(
        self, batch: int = 1, frames: int = 3, height: int = 8, width: int = 8
    ) -> tuple[Tensor, Tensor, Conditioning]:
        """Random latents, noise levels (0 for the first frame) and conditioning."""
        sigma = torch.linspace(0, 0.9, frames).repeat(batch, 1)
        latents = _noise((batch, frames, CHANNELS, height, width), seed=1)
        return latents, sigma, self.conditioning(batch, frames)


def check_model(model: str | Callable[..., DynamicsModel], **params: Any) -> Iterator[CheckResult]:
    """Check a model against the contract of `acwm_core.dynamics.DynamicsModel`.

    A denoiser is checked against that of `acwm_core.denoiser.Denoiser`, too.

    Weights are perturbed first: models start with layers at zero, which would hide their inputs.

    Args:
        model: a registered name, or the class.
        **params: constructor parameters, for instance a small width; not `latent_channels`.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: the name cannot be resolved.
    """
    make = functools.partial(factory("model", model), **params)
    trial = DynamicsTrial(make)
    yield from run_checks(DYNAMICS_CHECKS, trial)
    if trial.is_denoiser:
        yield from run_checks(CHECKS, ModelTrial(make))


def keeps_the_shape(trial: ModelTrial) -> None:
    """Return finite predictions of the latents' shape, whatever their length and size."""
    for size in SIZES:
        latents, sigma, conditioning = trial.inputs(*size)
        predicted = trial.run(latents, sigma, conditioning)
        shapes = list(latents.shape), list(predicted.shape)
        expect(shapes[0] == shapes[1], f"latents {shapes[0]} give a prediction {shapes[1]}")
        expect(predicted.isfinite().all(), "the prediction is not finite")


def gradient_reaches_every_parameter(trial: ModelTrial) -> None:
    """Train all parameters: none is idle."""
    predicted = trial.model(*trial.inputs(2))
    left_out = without_gradient(trial.model, predicted)
    expect(not left_out, f"no gradient reaches {', '.join(left_out[:3])}")


def elements_of_a_batch_are_independent(trial: ModelTrial) -> None:
    """Predict an element alike whatever else is in the batch."""
    latents, sigma, conditioning = trial.inputs(2)
    modulation = conditioning.modulation
    assert modulation is not None
    alone = Conditioning(modulation[1:], None, Probe(trial.model.layers))
    whole = trial.run(latents, sigma, conditioning)[1:]
    error = batch_error(whole, trial.run(latents[1:], sigma[1:], alone))
    expect(error < 1e-3, f"predictions change by {error:.2g} with the rest of the batch")


def sees_latents_and_noise_level(trial: ModelTrial) -> None:
    """Let the prediction depend on every latent frame and its noise level."""
    latents, sigma, conditioning = trial.inputs()
    usual = trial.run(latents, sigma, conditioning)
    for frame in range(latents.shape[1]):
        other, noisier = latents.clone(), sigma.clone()
        other[:, frame] += 1
        noisier[:, frame] += 0.1
        for name, changed in (
            ("latents", trial.run(other, sigma, conditioning)),
            ("noise level", trial.run(latents, noisier, conditioning)),
        ):
            same = torch.equal(usual[:, frame], changed[:, frame])
            expect(not same, f"its prediction of a frame ignores the frame's {name}")


def first_frame_reaches_every_other(trial: ModelTrial) -> None:
    """Let the prediction of every frame depend on the given first frame."""
    latents, sigma, conditioning = trial.inputs(frames=4)
    other = latents.clone()
    other[:, 0] = -other[:, 0]
    difference = trial.run(latents, sigma, conditioning) - trial.run(other, sigma, conditioning)
    for frame in range(1, latents.shape[1]):
        expect(difference[:, frame].any(), f"latent frame {frame} cannot see the first frame")


def is_causal_if_it_says_so(trial: ModelTrial) -> None:
    """With `causal` true, predict a frame without any look at later ones."""
    latents, sigma, conditioning = trial.inputs(frames=4)
    expect_is_a(trial.model.causal, bool)
    if not trial.model.causal:
        return
    usual = trial.run(latents, sigma, conditioning)
    for frame in range(1, latents.shape[1]):
        other, noisier = latents.clone(), sigma.clone()
        other[:, frame] += 1
        noisier[:, frame] += 0.1
        changed = trial.run(other, noisier, conditioning)
        error = batch_error(usual[:, :frame], changed[:, :frame])
        expect(error < 1e-4, f"what it predicts before latent frame {frame} depends on that frame")


def frame_by_frame_it_predicts_the_same(trial: ModelTrial) -> None:
    """With a cache, predict what all frames at once give, in and beyond the context."""
    model = trial.model
    if type(model).new_cache is Denoiser.new_cache:
        return
    try:
        model.new_cache(2)
    except RecipeError:
        expect(not model.causal, "it is causal and has a cache, but refuses to make one")
        return
    latents, sigma, conditioning = trial.inputs(batch=2, frames=6)
    for context, expected in (
        (6, trial.run(latents, sigma, conditioning)),
        (3, trial.extend(model.new_cache(3), latents, sigma, conditioning)),
    ):
        cache = model.new_cache(context)
        for start, stop in ((0, 1), (1, 3), (3, 4), (4, 6)):
            # What is evaluated and not kept must leave no trace: streams do so at every step.
            trial.extend(cache, -latents, sigma, conditioning, start, stop)
            predicted = trial.extend(cache, latents, sigma, conditioning, start, stop)
            cache.keep(stop - start)
            error = batch_error(expected[:, start:stop], predicted)
            expect(error < 1e-4, f"cached and uncached differ by {error:.2g} at frame {start}")


def uses_the_modulation(trial: ModelTrial) -> None:
    """Depend on the conditioner's modulation of each frame, and do without one."""
    latents, sigma, conditioning = trial.inputs()
    other = trial.conditioning(*latents.shape[:2], seed=4)
    usual, changed = (trial.run(latents, sigma, c) for c in (conditioning, other))
    for frame in range(latents.shape[1]):
        same = torch.equal(usual[:, frame], changed[:, frame])
        expect(not same, f"the modulation of latent frame {frame} has no effect")
    trial.run(latents, sigma, Conditioning(None, None, Probe(trial.model.layers)))


def calls_the_conditioner_after_every_layer(trial: ModelTrial) -> None:
    """Call `inject` once after each layer, in order, and go on with what it returns."""
    latents, sigma, _ = trial.inputs()
    model = trial.model
    quiet = Probe(model.layers)
    usual = trial.run(latents, sigma, Conditioning(None, None, quiet))
    expect(
        quiet.called == list(range(model.layers)),
        f"inject is called for layers {quiet.called}, not for each of {model.layers} in order",
    )
    loud = Probe(model.layers, offset=_noise((model.width,), seed=5))
    changed = trial.run(latents, sigma, Conditioning(None, None, loud))
    expect(not torch.equal(usual, changed), "it ignores the tokens that inject returns")


def _noise(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


CHECKS = (
    keeps_the_shape,
    gradient_reaches_every_parameter,
    elements_of_a_batch_are_independent,
    sees_latents_and_noise_level,
    first_frame_reaches_every_other,
    is_causal_if_it_says_so,
    frame_by_frame_it_predicts_the_same,
    uses_the_modulation,
    calls_the_conditioner_after_every_layer,
)
