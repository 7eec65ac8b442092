"""Checks of every dynamics model, whether it is a denoiser or not."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import Literal

import torch
from torch import Tensor

from acwm_core.checks.result import Suite, expect, expect_equal, expect_is_a
from acwm_core.checks.trial import batch_error, noise, shaken, without_gradient
from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.denoiser import Denoiser
from acwm_core.model.dynamics import DynamicsModel
from acwm_core.model.flow import Flow, Objective
from acwm_core.model.shapes import Actions, Latent, Tokens

SHAPE = (2, 4, 4, 8, 8)
"""B, L, C, h, w of the latents used in the checks."""


Place = int | Literal["input"]
"""Where a conditioner acts: before the first layer, or after the layer of this number."""


class Probe(Conditioner):
    """Records where it is called, and changes the tokens at some places.

    Args:
        changed: the places where it adds something to the tokens.

    Attributes:
        called: the places where it was called, in order, each with the width of the tokens.
    """

    def __init__(self, changed: Iterable[Place] = ()) -> None:
        super().__init__()
        self.changed = {*changed}
        self.called: list[tuple[Place, int]] = []

    def forward(self, actions: Actions) -> Conditioning:
        """An empty conditioning; `actions` are ignored."""
        return Conditioning(None, None, self)

    def inject_input(self, tokens: Tokens, conditioning: Conditioning) -> Tokens:
        """Record the call."""
        return self._act("input", tokens)

    def inject(self, layer: int, tokens: Tokens, conditioning: Conditioning) -> Tokens:
        """Record the call."""
        return self._act(layer, tokens)

    def _act(self, place: Place, tokens: Tokens) -> Tokens:
        width = tokens.shape[-1]
        self.called.append((place, width))
        return tokens + noise((width,), seed=5) if place in self.changed else tokens


class DynamicsChecks(Suite):
    """Checks of a model on random latents; weights are perturbed so that no layer is zero."""

    kind = "model"

    @functools.cached_property
    def _model(self) -> DynamicsModel:
        model: DynamicsModel = shaken(self.make(latent_channels=SHAPE[2])).eval()
        if isinstance(model, Denoiser):
            model.flow = Flow(objective=_objective(model), prediction="clean", steps=2)
        return model

    def _conditioning(self, modulation: Tensor, probe: Probe | None = None) -> Conditioning:
        return Conditioning(modulation, None, probe or Probe())

    def _inputs(self) -> tuple[Latent, Tensor]:
        """Random latents `[B, L, C, h, w]` and modulation `[B, L, D]`."""
        return noise(SHAPE, seed=1), noise((*SHAPE[:2], self._model.width), seed=3)

    @torch.no_grad()
    def _predict(self, given: Latent, modulation: Tensor, probe: Probe | None = None) -> Latent:
        conditioning = self._conditioning(modulation, probe)
        return self._model.predict(given, conditioning, SHAPE[1], _generators(len(given)))

    @property
    def is_denoiser(self) -> bool:
        """Whether the model is a denoiser; False if it cannot be constructed."""
        try:
            return isinstance(self._model, Denoiser)
        except Exception:  # already reported by the check `can_be_constructed`
            return False

    def can_be_constructed(self) -> None:
        """Construct the model and find `width`, `layers`, `heads`, `sampling_steps`, `causal`."""
        expect_is_a(self._model, DynamicsModel)
        expect_is_a(self._model.causal, bool)
        for name, least in (("width", 1), ("layers", 0), ("heads", 1), ("sampling_steps", 1)):
            value = getattr(self._model, name, None)
            expect_is_a(value, int)
            expect(value is not None and value >= least, f"{name} is {value!r}, below {least}")
        widths, heads = self._model.widths, self._model.heads
        expect_equal("the number of widths is", len(widths), self._model.layers)
        for width in widths:
            expect_is_a(width, int)
            fits = width > 0 and width % heads == 0
            expect(fits, f"{heads} heads do not divide the width {width} of a layer")

    def gradient_reaches_every_parameter(self) -> None:
        """Return a finite loss that trains all parameters, with 1 or 2 `given_frames`."""
        latents, modulation = self._inputs()
        conditioning, generators = self._conditioning(modulation), _generators(len(latents))
        for self._model.given_frames in (2, 1):
            loss = self._model.loss(latents, conditioning, generators)
            expect(loss.ndim == 0 and bool(loss.isfinite()), f"the loss is {loss}")
            idle = without_gradient(self._model, loss)
            expect(not idle, f"no gradient reaches {', '.join(idle[:3])}")

    def names_its_own_matrices(self) -> None:
        """Let `matrices` list parameters of the model that have two dimensions, each once."""
        own = {id(parameter) for parameter in self._model.parameters()}
        listed = self._model.matrices()
        expect_is_a(listed, list)
        found = [id(each) for each in listed]
        expect({*found} <= own, "matrices lists what is no parameter of the model")
        expect(len({*found}) == len(found), "matrices lists a parameter twice")
        wrong = [tuple(each.shape) for each in listed if each.ndim != 2]
        expect(not wrong, f"matrices lists a parameter of shape {(wrong or [()])[0]}")

    def keeps_the_given_frames(self) -> None:
        """Predict finite latents of the requested length; 1 or 2 given frames stay unchanged."""
        latents, modulation = self._inputs()
        for known in (1, 2):
            given = latents[:, :known]
            predicted = self._predict(given, modulation)
            expect_equal("predicts", [*predicted.shape], [*SHAPE])
            expect(predicted.isfinite().all(), "the prediction is not finite")
            expect(torch.equal(predicted[:, :known], given), "the given frames come out changed")

    def elements_of_a_batch_are_independent(self) -> None:
        """Predict an element the same way whatever else is in the batch."""
        latents, modulation = self._inputs()
        whole = self._predict(latents[:, :1], modulation)[:1]
        error = batch_error(whole, self._predict(latents[:1, :1], modulation[:1]))
        expect(error < 1e-3, f"predictions change by {error:.2g} with the rest of the batch")

    def depends_on_the_first_frame_and_the_actions(self) -> None:
        """Let every predicted frame depend on the first one and on the actions."""
        latents, modulation = self._inputs()
        usual = self._predict(latents[:, :1], modulation)
        for what, changed in (
            ("the first frame", self._predict(-latents[:, :1], modulation)),
            ("the actions", self._predict(latents[:, :1], -modulation)),
        ):
            for frame in range(1, SHAPE[1]):
                same = torch.equal(usual[:, frame], changed[:, frame])
                expect(not same, f"what it predicts of latent frame {frame} ignores {what}")

    def later_actions_change_nothing_if_causal(self) -> None:
        """With `causal` true, predict a frame independently of the actions after it."""
        latents, modulation = self._inputs()
        other = modulation.clone()
        other[:, -1] += 1
        usual, changed = (self._predict(latents[:, :1], m) for m in (modulation, other))
        error = batch_error(usual[:, :-1], changed[:, :-1])
        what = f"earlier frames change by {error:.2g} with the last action"
        expect(error < 1e-4 or not self._model.causal, what)

    def lets_the_conditioner_act_at_the_input(self) -> None:
        """With layers, call `inject_input` before the first, and go on with what it returns."""
        if self._model.layers:
            self._expect_heeded("input", self._model.width, "inject_input")

    def lets_the_conditioner_act_after_every_layer(self) -> None:
        """Call `inject` after each layer, with its width, and go on with what it returns."""
        for layer, width in enumerate(self._model.widths):
            self._expect_heeded(layer, width, f"inject for layer {layer}")

    def _expect_heeded(self, place: Place, width: int, method: str) -> None:
        """Expect tokens of this width at a place, and another prediction if they change there."""
        latents, modulation = self._inputs()
        usual, probe = self._predict(latents[:, :1], modulation), Probe([place])
        changed = self._predict(latents[:, :1], modulation, probe)
        found = {wide for where, wide in probe.called if where == place}
        why = "so a conditioner that acts there has no effect"
        expect(found, f"it never calls {method}, {why}")
        expect_equal(f"{method} gets tokens of the width", [*found], [width])
        expect(not torch.equal(usual, changed), f"it ignores the tokens of {method}, {why}")

    def streams_what_it_predicts(self) -> None:
        """Stream finite frames (the same as predicted, unless a denoiser), or refuse to stream."""
        latents, modulation = self._inputs()
        frames, conditioning = SHAPE[1], self._conditioning(modulation)
        for known in (1, 2):
            given = latents[:, :known]
            try:
                stream = self._model.stream(given, _generators(len(given)), context=frames)
            except RecipeError:
                expect(not self._model.streams_by_default, "it refuses to stream as it was trained")
                return
            expect(self._model.causal, "it streams, but does not say that it is causal")
            seen = [0, *range(known, frames - 1)]  # the first call covers all given frames
            with torch.no_grad():
                parts = [
                    stream.advance(conditioning.frames(start, stop))
                    for start, stop in zip(seen, range(known + 1, frames + 1), strict=True)
                ]
            streamed, predicted = torch.cat(parts, 1), self._predict(given, modulation)[:, known:]
            expect_equal("a stream gives", [*streamed.shape], [*predicted.shape])
            expect(streamed.isfinite().all(), "a streamed frame is not finite")
            error = batch_error(predicted, streamed)
            what = f"after {known} given frames a stream and a prediction differ by {error:.2g}"
            expect(error < 1e-3 or isinstance(self._model, Denoiser), what)


def _objective(model: Denoiser) -> Objective:
    """The most demanding objective that a denoiser supports."""
    if not model.causal:
        return "full_sequence"
    return "next_frame" if model.previous else "diffusion_forcing"


def _generators(batch: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in range(batch)]
