"""`check_model`: the contract of dynamics models, and what objectives require of each kind."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from acwm_core.checks.result import (
    CheckResult,
    NotTried,
    Suite,
    expect,
    expect_equal,
    expect_is_a,
    run_checks,
)
from acwm_core.checks.trial import (
    DenoisingTrial,
    Place,
    PredictionTrial,
    Probe,
    batch_error,
    batch_of,
    draws,
    further_inputs,
    noise,
    probed,
    shaken,
    without_gradient,
)
from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Cache, Denoiser, DynamicsModel, Predictor
from acwm_core.model.objectives.objective import Objective
from acwm_core.model.objectives.regression import Regression
from acwm_core.model.shapes import Latent
from acwm_core.training.run import check_savable

SHAPE = (2, 4, 4, 8, 8)
"""B, L, C, h, w of the latents used in the checks."""


def check_model(model: str | Callable[..., DynamicsModel], **params: Any) -> Iterator[CheckResult]:
    """Check a model against the contract of `acwm_core.model.dynamics.DynamicsModel`.

    A denoiser is also checked against the contract of `acwm_core.model.dynamics.Denoiser`.

    Weights are perturbed first: many models start with zero layers, which would hide their inputs.

    Args:
        model: a registered name, or the class.
        **params: constructor parameters, for instance a small width; not `latent_channels`.
    """
    checks = DynamicsChecks(model, **params)
    yield from run_checks(checks)
    if checks.is_denoiser:
        yield from DenoiserChecks.check(model, **params)


class DynamicsChecks(PredictionTrial):
    """Checks of a model on random latents; weights are perturbed so that no layer is zero."""

    kind = "model"

    @functools.cached_property
    def _model(self) -> DynamicsModel:
        return shaken(self.make(latent_channels=SHAPE[2])).eval()

    @functools.cached_property
    def _objective(self) -> Objective[Any]:
        return DenoisingTrial(prediction="clean", steps=2) if self.is_denoiser else Regression()

    def _inputs(self) -> tuple[Latent, Tensor]:
        return noise(SHAPE, seed=1), noise((*SHAPE[:2], self._model.width), seed=3)

    def _streamed(self, known: int, first: int = 0) -> Latent:
        if isinstance(self._model, Denoiser) and self._model.inputs:
            raise NotTried("its further inputs come from an objective")
        return super()._streamed(known, first)

    @property
    def is_denoiser(self) -> bool:
        """Whether the model is a denoiser; False if it cannot be constructed."""
        try:
            return isinstance(self._model, Denoiser)
        except Exception:  # already reported by the check `can_be_constructed`
            return False

    def can_be_constructed(self) -> None:
        """Construct the model and find `width`, `layers`, `heads` and `causal`."""
        expect_is_a(self._model, DynamicsModel)
        expect(
            isinstance(self._model, Denoiser | Predictor),
            "it is neither a Denoiser nor a Predictor, so no objective can train it",
        )
        expect_is_a(self._model.causal, bool)
        for name, least in (("width", 1), ("layers", 0), ("heads", 1)):
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
        """Return a finite loss that trains all parameters, with 1 or 2 given frames."""
        latents, modulation = self._inputs()
        for known in (2, 1):
            loss = self._objective.loss(self._model, batch_of(latents, modulation), known)
            expect(loss.ndim == 0 and bool(loss.isfinite()), f"the loss is {loss}")
            idle = without_gradient(self._model, loss)
            expect(not idle, f"no gradient reaches {', '.join(idle[:3])}")

    def names_its_own_matrices(self) -> None:
        """Let `matrices` list parameters of the model that have two dimensions, each once."""
        own = {id(parameter) for parameter in self._model.parameters()}
        listed = self._model.matrices()
        expect_is_a(listed, list)
        ids = [id(matrix) for matrix in listed]
        expect({*ids} <= own, "matrices lists something that is not a parameter of the model")
        expect(len({*ids}) == len(ids), "matrices lists a parameter twice")
        wrong = [tuple(matrix.shape) for matrix in listed if matrix.ndim != 2]
        expect(not wrong, f"matrices lists a parameter of shape {(wrong or [()])[0]}")

    def weights_can_be_saved(self) -> None:
        """Have a state dict of plain tensors, which a run stores as safetensors."""
        check_savable(self._model.state_dict())

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
        if not self._model.causal:
            raise NotTried("it is not causal")
        latents, modulation = self._inputs()
        other = modulation.clone()
        other[:, -1] += 1
        usual, changed = (self._predict(latents[:, :1], m) for m in (modulation, other))
        error = batch_error(usual[:, :-1], changed[:, :-1])
        expect(error < 1e-4, f"earlier frames change by {error:.2g} with the last action")

    def lets_the_conditioner_act_at_the_input(self) -> None:
        """With layers, call `inject_input` before the first, and go on with what it returns."""
        if not self._model.layers:
            raise NotTried("it has no layers")
        self._expect_heeded("input", self._model.width, "inject_input")

    def lets_the_conditioner_act_after_every_layer(self) -> None:
        """Call `inject` after each layer, with its width, and go on with what it returns."""
        if not self._model.layers:
            raise NotTried("it has no layers")
        for layer, width in enumerate(self._model.widths):
            self._expect_heeded(layer, width, f"inject for layer {layer}")

    def _expect_heeded(self, place: Place, width: int, method: str) -> None:
        """Expect tokens of this width at a place, and another prediction if they change there."""
        latents, modulation = self._inputs()
        usual, probe = self._predict(latents[:, :1], modulation), Probe([place])
        changed = self._predict(latents[:, :1], modulation, probe)
        widths = {wide for where, wide in probe.called if where == place}
        why = "so a conditioner that acts there has no effect"
        expect(widths, f"it never calls {method}, {why}")
        expect_equal(f"{method} gets tokens of the width", [*widths], [width])
        expect(not torch.equal(usual, changed), f"it ignores the tokens of {method}, {why}")

    def streams_what_it_predicts(self) -> None:
        """Stream finite frames (the same as predicted, unless a denoiser), or refuse to stream."""
        latents, modulation = self._inputs()
        for known in (1, 2):
            streamed = self._streamed(known)
            expect(self._model.causal, "it streams, but does not say that it is causal")
            predicted = self._predict(latents[:, :known], modulation)[:, known:]
            error = batch_error(predicted, streamed)
            what = f"after {known} given frames a stream and a prediction differ by {error:.2g}"
            expect(error < 1e-3 or self.is_denoiser, what)

    @torch.no_grad()
    def returns_only_the_frames_asked_for(self) -> None:
        """Let `predict_frames` return the same frames as `forward`."""
        model = self._model
        if not (isinstance(model, Predictor) and model.implements("predict_frames")):
            raise NotTried("it saves no work when fewer frames are requested")
        latents, modulation = self._inputs()
        batch, frames = SHAPE[:2]
        numbers = torch.arange(batch)[:, None] % (frames - 1)
        clip = latents[:, :1], probed(modulation), frames
        whole = model(*clip, draws(batch))
        some = model.predict_frames(*clip, numbers, draws(batch))
        error = batch_error(whole.take_along_dim(numbers[..., None, None, None], 1), some)
        expect(error < 1e-3, f"predict_frames returns frames that differ by {error:.2g}")

    @torch.no_grad()
    def predicts_states_of_every_frame(self) -> None:
        """Let `predict_states` follow the actions, the first ones of each clip first."""
        model = self._model
        if not (isinstance(model, Predictor) and model.implements("predict_states")):
            raise NotTried("it predicts no states")
        latents, modulation = self._inputs()
        batch, frames = SHAPE[:2]
        given, changed = latents[:, :1], modulation.clone()
        changed[:, -1] += 1
        try:
            usual, other = (
                model.predict_states(given, probed(actions), frames, draws(batch))
                for actions in (modulation, changed)
            )
        except RecipeError as error:  # it has yet to measure them
            raise NotTried(str(error)) from None
        expect(usual.ndim == 3 and len(usual) == batch, f"states are {list(usual.shape)}")
        per_frame, rest = divmod(usual.shape[1], frames - 1)
        expect(per_frame > 0 and not rest, f"states of {usual.shape[1]} video frames")
        expect(not usual.isinf().any(), "states are infinite")
        before = usual.shape[1] - per_frame
        same = usual[:, :before].allclose(other[:, :before], 1e-4, 1e-4, equal_nan=True)
        expect(same, "states of earlier frames change with the last action")
        alike = model.predict_states(given[:1], probed(modulation), frames, draws(batch))
        error = batch_error(usual[:1].nan_to_num(), alike[:1].nan_to_num())
        expect(error < 1e-3, "a beginning that all clips share gives other states")

    @torch.no_grad()
    def carries_the_states_that_it_predicts(self) -> None:
        """Compare `carry_states`, of scenes that are picked and put too, with `predict_states`."""
        model = self._model
        if not (isinstance(model, Predictor) and model.implements("carry_states")):
            raise NotTried("it carries no states")
        latents, modulation = self._inputs()
        batch, frames = SHAPE[:2]
        clip, conditioning = latents[:, :1], probed(modulation)
        try:
            whole = model.predict_states(clip, conditioning, frames, draws(batch))
            begun = model.carry_states(clip, draws(batch))
        except RecipeError as error:  # it has yet to measure them
            raise NotTried(str(error)) from None
        carried, last = begun.picked(torch.arange(batch)), torch.tensor([batch - 1])
        steps = [conditioning.frames(frame - 1, frame + 1) for frame in range(1, frames)]
        passed = torch.cat([carried.advance(step) for step in steps], 1)
        error = batch_error(whole.nan_to_num(), passed.nan_to_num())
        expect(error < 1e-3, f"the carried states differ by {error:.2g}")
        alone = begun.picked(torch.arange(batch)).only([0])
        first = torch.cat([alone.advance(step)[..., 0] for step in steps], 1)
        error = batch_error(whole[..., 0].nan_to_num(), first.nan_to_num())
        expect(error < 1e-3, f"for who needs the first value alone, it differs by {error:.2g}")
        now = carried.current.allclose(passed[:, -1], 1e-4, 1e-4, equal_nan=True)
        expect(now, "`current` is not the last of the states")
        carried.put(last, begun.picked(last))  # one begins anew while the others go on
        passed = torch.cat([carried.advance(step) for step in steps], 1)
        error = batch_error(whole[last].nan_to_num(), passed[last].nan_to_num())
        expect(error < 1e-3, f"the states of a scene that begins anew differ by {error:.2g}")


class DenoiserChecks(Suite):
    """Checks of a denoiser on random latents."""

    kind = "model"

    @functools.cached_property
    def _model(self) -> Denoiser:
        return shaken(self.make(latent_channels=SHAPE[2])).eval()

    def _conditioning(self, batch: int, frames: int, seed: int = 3) -> Conditioning:
        modulation = noise((batch, frames, self._model.width), seed)
        return probed(modulation, Probe(("input", *range(self._model.layers))))

    def _inputs(
        self, batch: int = 1, frames: int = 3, height: int = 8, width: int = 8
    ) -> tuple[Tensor, Tensor, Conditioning]:
        """Random latents, noise levels (0 for the first frame) and conditioning."""
        sigma = torch.linspace(0, 0.9, frames).repeat(batch, 1)
        latents = noise((batch, frames, SHAPE[2], height, width), seed=1)
        return latents, sigma, self._conditioning(batch, frames)

    @torch.no_grad()
    def _run(
        self, latents: Tensor, sigma: Tensor, conditioning: Conditioning, **changed: Tensor
    ) -> Tensor:
        inputs = further_inputs(self._model, *latents.shape)
        return self._model(latents, sigma, conditioning, **{**inputs, **changed})

    @torch.no_grad()
    def _extend(
        self, cache: Cache, clip: tuple[Tensor, Tensor, Conditioning], start: int, stop: int
    ) -> Tensor:
        latents, sigma, conditioning = clip
        rows = slice(start, stop)
        inputs = further_inputs(self._model, *latents.shape)
        now = {name: values[:, rows] for name, values in inputs.items()}
        frames = conditioning.frames(start, stop)
        return self._model.extend(latents[:, rows], sigma[:, rows], frames, cache, **now)

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

    def sees_its_further_inputs(self) -> None:
        """Let the prediction of a frame depend on each of its `inputs`."""
        latents, sigma, conditioning = self._inputs()
        usual = self._run(latents, sigma, conditioning)
        inputs = further_inputs(self._model, *latents.shape)
        if not inputs:
            raise NotTried("it has none")
        for name, given in inputs.items():
            changed = self._run(latents, sigma, conditioning, **{name: 1 - given})
            for frame in range(latents.shape[1]):
                same = torch.equal(usual[:, frame], changed[:, frame])
                expect(not same, f"its prediction of a frame ignores the frame's input {name}")

    def is_causal_if_it_says_so(self) -> None:
        """With `causal` true, predict a frame independently of later ones."""
        if not self._model.causal:
            raise NotTried("it is not causal")
        latents, sigma, conditioning = self._inputs(frames=4)
        usual = self._run(latents, sigma, conditioning)
        for frame in range(1, latents.shape[1]):
            changed = self._run(*_changed(latents, sigma, frame), conditioning)
            error = batch_error(usual[:, :frame], changed[:, :frame])
            what = f"what it predicts before latent frame {frame} depends on that frame"
            expect(error < 1e-4, what)

    def frame_by_frame_it_predicts_the_same(self) -> None:
        """With a cache, predict the same as for all frames at once, in and beyond the context."""
        model, inputs = self._model, self._inputs(batch=2, frames=6)
        if type(model).new_cache is Denoiser.new_cache:
            raise NotTried("it has no cache")
        try:
            model.new_cache(2)
        except RecipeError as error:
            expect(not model.causal, "it is causal and has a cache, but refuses to make one")
            raise NotTried(str(error)) from None
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
