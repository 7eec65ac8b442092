"""Checks of what every dynamics model promises, whether it denoises or not."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
from torch import Tensor

from acwm_core.checks.result import expect, expect_is_a
from acwm_core.checks.weights import batch_error, shaken
from acwm_core.conditioner import Conditioner, Conditioning
from acwm_core.denoiser import Denoiser
from acwm_core.dynamics import DynamicsModel
from acwm_core.errors import RecipeError
from acwm_core.flow import Flow
from acwm_core.shapes import Actions, Latent

CHANNELS, SIDE, FRAMES = 4, 8, 4
"""C, h = w and L of the latents that are tried."""


class NoLayers(Conditioner):
    """A conditioner that acts through its modulation alone."""

    def forward(self, actions: Actions) -> Conditioning:
        """A conditioning without content; `actions` are not looked at."""
        return Conditioning(None, None, self)


class DynamicsTrial:
    """A model whose zero-initialised layers were shaken awake, and inputs for it.

    Args:
        make: constructs the model; takes `latent_channels`.
    """

    def __init__(self, make: Callable[..., DynamicsModel]) -> None:
        self.make = make

    @functools.cached_property
    def model(self) -> DynamicsModel:
        """One instance; a denoiser with a flow that fits it."""
        model = shaken(self.make(latent_channels=CHANNELS)).eval()
        if isinstance(model, Denoiser):
            objective = "diffusion_forcing" if model.causal else "full_sequence"
            model.flow = Flow(objective=objective, prediction="clean", steps=2)
        return model

    @property
    def is_denoiser(self) -> bool:
        """Whether the model is one; False if it cannot be constructed."""
        try:
            return isinstance(self.model, Denoiser)
        except Exception:  # the check of its construction has told
            return False

    def latents(self, batch: int = 2, frames: int = FRAMES, seed: int = 1) -> Latent:
        """Random latents `[B, L, C, h, w]`."""
        return _noise((batch, frames, CHANNELS, SIDE, SIDE), seed)

    def conditioning(self, batch: int = 2, frames: int = FRAMES, seed: int = 3) -> Conditioning:
        """Random modulation."""
        return Conditioning(_noise((batch, frames, self.model.width), seed), None, NoLayers())

    def predict(self, given: Latent, conditioning: Conditioning) -> Latent:
        """A clip of `FRAMES` latent frames, the same noise every time."""
        with torch.no_grad():
            return self.model.predict(given, conditioning, FRAMES, generators(len(given)))


def generators(batch: int) -> list[torch.Generator]:
    """One per clip, always the same."""
    return [torch.Generator().manual_seed(seed) for seed in range(batch)]


def can_be_constructed(trial: DynamicsTrial) -> None:
    """Construct the model and find `width`, `layers`, `heads` and `steps`."""
    model = trial.model
    expect_is_a(model, DynamicsModel)
    for name, least in (("width", 1), ("layers", 0), ("heads", 1), ("steps", 1)):
        value = getattr(model, name, None)
        expect_is_a(value, int)
        expect(value is not None and value >= least, f"{name} is {value!r}, below {least}")
    expect_is_a(model.causal, bool)


def loss_is_a_finite_scalar_that_trains(trial: DynamicsTrial) -> None:
    """Return one finite number whose gradient reaches every trainable parameter."""
    loss = trial.model.loss(trial.latents(), trial.conditioning(), generators(2))
    expect(loss.ndim == 0 and bool(loss.isfinite()), f"the loss is {loss}")
    named = {name: p for name, p in trial.model.named_parameters() if p.requires_grad}
    found: list[Tensor | None] = list(
        torch.autograd.grad(loss, list(named.values()), allow_unused=True)
    )
    idle = [name for name, g in zip(named, found, strict=True) if g is None or not g.any()]
    expect(not idle, f"no gradient of the loss reaches {', '.join(idle[:3])}")


def keeps_the_given_frames(trial: DynamicsTrial) -> None:
    """Predict finite latents of the wanted length after 1 or 2 given frames, which stay."""
    for known in (1, 2):
        given = trial.latents()[:, :known]
        predicted = trial.predict(given, trial.conditioning())
        wanted = [2, FRAMES, CHANNELS, SIDE, SIDE]
        expect(list(predicted.shape) == wanted, f"predicts {list(predicted.shape)}, not {wanted}")
        expect(predicted.isfinite().all(), "the prediction is not finite")
        expect(torch.equal(predicted[:, :known], given), "the given frames come out changed")


def predicts_an_element_alike_in_any_batch(trial: DynamicsTrial) -> None:
    """Predict a clip alike whatever else is in the batch."""
    given, conditioning = trial.latents()[:, :1], trial.conditioning()
    assert conditioning.modulation is not None
    alone = Conditioning(conditioning.modulation[:1], None, NoLayers())
    whole = trial.predict(given, conditioning)[:1]
    error = batch_error(whole, trial.predict(given[:1], alone))
    expect(error < 1e-3, f"predictions change by {error:.2g} with the rest of the batch")


def predictions_depend_on_actions_and_start(trial: DynamicsTrial) -> None:
    """Let every predicted frame depend on the first frame and on the action that leads to it."""
    given, conditioning = trial.latents()[:, :1], trial.conditioning()
    usual = trial.predict(given, conditioning)
    for what, changed in (
        ("the first frame", trial.predict(-given, conditioning)),
        ("the actions", trial.predict(given, trial.conditioning(seed=4))),
    ):
        for frame in range(1, FRAMES):
            same = torch.equal(usual[:, frame], changed[:, frame])
            expect(not same, f"what it predicts of latent frame {frame} ignores {what}")


def predicts_without_later_actions_if_causal(trial: DynamicsTrial) -> None:
    """With `causal` true, predict a frame alike whatever the actions after it."""
    if not trial.model.causal:
        return
    given, conditioning = trial.latents()[:, :1], trial.conditioning()
    assert conditioning.modulation is not None
    other = conditioning.modulation.clone()
    other[:, -1] += 1
    usual = trial.predict(given, conditioning)
    changed = trial.predict(given, Conditioning(other, None, NoLayers()))
    error = batch_error(usual[:, :-1], changed[:, :-1])
    expect(error < 1e-4, f"earlier frames change by {error:.2g} with the last action")


def streams_what_it_predicts(trial: DynamicsTrial) -> None:
    """Offer a stream of finite frames, or refuse it in one sentence; without noise, the same."""
    model, given, conditioning = trial.model, trial.latents()[:, :1], trial.conditioning()
    try:
        stream = model.stream(given, generators(2), context=FRAMES)
    except RecipeError:
        return
    expect(model.causal, "it streams, but does not say that it is causal")
    with torch.no_grad():
        parts = [stream.advance(conditioning.frames(n - 1, n + 1)) for n in range(1, FRAMES)]
    streamed = torch.cat(parts, 1)
    shapes = list(streamed.shape), [2, FRAMES - 1, CHANNELS, SIDE, SIDE]
    expect(shapes[0] == shapes[1], f"a stream of three steps gives {shapes[0]}, not {shapes[1]}")
    expect(streamed.isfinite().all(), "a streamed frame is not finite")
    if not isinstance(model, Denoiser):
        error = batch_error(trial.predict(given, conditioning)[:, 1:], streamed)
        expect(error < 1e-3, f"a stream and a prediction of the clip differ by {error:.2g}")


def _noise(shape: tuple[int, ...], seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


DYNAMICS_CHECKS = (
    can_be_constructed,
    loss_is_a_finite_scalar_that_trains,
    keeps_the_given_frames,
    predicts_an_element_alike_in_any_batch,
    predictions_depend_on_actions_and_start,
    predicts_without_later_actions_if_causal,
    streams_what_it_predicts,
)
