"""Checks of an objective: what training and rollouts require of it, on the smallest models."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, cast, get_args

import torch
from torch import Tensor, nn

from acwm_core.checks.model import Probe, draws, played
from acwm_core.checks.result import NotTried, Suite, expect, expect_equal, expect_is_a
from acwm_core.checks.trial import batch_error, noise
from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import (
    Cache,
    Denoiser,
    DynamicsModel,
    InputKind,
    LatentStream,
    Predictor,
)
from acwm_core.model.objectives.objective import Batch, Objective
from acwm_core.model.shapes import Latent, Sigmas

BATCH, FRAMES, CHANNELS, SIDE = 2, 5, 2, 4
WIDTH = 4

LESSONS = 150
"""Steps of the training in which a loss has to fall."""


class ObjectiveChecks(Suite):
    """Checks of an `acwm_core.model.objectives.objective.Objective` on tiny models.

    Their latents move by what the actions say, so that there is something to learn.
    """

    kind = "objective"

    @functools.cached_property
    def _objective(self) -> Objective[Any]:
        return self.make()

    def _model(self) -> DynamicsModel:
        cast(Any, torch).manual_seed(0)
        denoises = issubclass(self._objective.trains, Denoiser)
        return TinyDenoiser(self._objective.inputs) if denoises else TinyPredictor()

    def _clips(self, batch: int = BATCH, seed: int = 1, draw: int = 0) -> Batch:
        """Latents `[B, L, C, h, w]` that move by the modulation `[B, L, D]` of their actions."""
        actions = noise((batch, FRAMES, WIDTH), seed)
        start = noise((batch, 1, CHANNELS, SIDE, SIDE), seed + 1)
        moves = actions[:, :, :CHANNELS].cumsum(1) - actions[:, :1, :CHANNELS]
        latents = start + 0.5 * moves[..., None, None]
        return Batch(latents, Conditioning(actions, None, Probe()), draws(batch, draw))

    @torch.no_grad()
    def _predict(self, batch: int = BATCH, steps: int | None = None, known: int = 1) -> Latent:
        given = _part(self._clips(), slice(batch), known)
        return self._objective.predict(self._model(), given, FRAMES, steps)

    def can_be_constructed(self) -> None:
        """Construct the objective and find `trains`, `causal`, `inputs` and `steps`."""
        expect_is_a(self._objective, Objective)
        kinds = (Denoiser, Predictor)
        trains: Any = getattr(self._objective, "trains", None)
        fits = isinstance(trains, type) and issubclass(trains, kinds)
        expect(fits, f"trains is {trains!r}, neither Denoiser nor Predictor")
        wrong = [k for k in self._objective.inputs.values() if k not in get_args(InputKind)]
        expect(not wrong, f"inputs has {wrong}, which is neither 'latent' nor 'level'")
        steps: Any = self._objective.steps
        good = steps is None or (isinstance(steps, int) and steps >= 1)
        expect(good, f"steps is {steps!r}, neither None nor at least 1")

    def takes_only_models_that_it_can_train(self) -> None:
        """Let `check_model` accept a model with all that is required, and refuse others."""
        self._objective.check_model(self._model())
        others: list[DynamicsModel] = [
            TinyPredictor() if issubclass(self._objective.trains, Denoiser) else TinyDenoiser({})
        ]
        others += [TinyDenoiser({})] if self._objective.inputs else []
        for other in others:
            try:
                self._objective.check_model(other)
            except RecipeError:
                continue
            expect(False, f"it accepts a {type(other).__name__}, which it cannot train")

    def the_loss_is_a_finite_number(self) -> None:
        """Return a finite scalar with a gradient."""
        loss = self._objective.loss(self._model(), self._clips(), 1)
        expect(loss.ndim == 0 and bool(loss.isfinite()), f"the loss is {loss}")
        expect(loss.requires_grad, "no gradient reaches the model")

    def all_randomness_comes_from_the_generators(self) -> None:
        """Give the same loss and prediction for the same generators, whatever torch's state."""
        losses: list[float] = []
        predictions: list[Tensor] = []
        for seed in (1, 2):
            model = self._model()
            cast(Any, torch).manual_seed(seed)
            losses.append(self._objective.loss(model, self._clips(), 1).item())
            given = _part(self._clips(), slice(BATCH), 1)
            cast(Any, torch).manual_seed(seed)
            with torch.no_grad():
                predictions.append(self._objective.predict(model, given, FRAMES))
        expect(losses[0] == losses[1], "the loss depends on torch's own random numbers")
        same = torch.equal(*predictions)
        expect(same, "predictions depend on torch's own random numbers")

    def clips_of_a_batch_are_independent(self) -> None:
        """Average the loss over clips, and predict a clip the same way beside any others."""
        model = self._model()
        whole = self._objective.loss(model, self._clips(), 1).item()
        alone = [
            self._objective.loss(model, _part(self._clips(), slice(k, k + 1), FRAMES), 1).item()
            for k in range(BATCH)
        ]
        mean = sum(alone) / BATCH
        off = abs(whole - mean) / max(abs(mean), 1e-6)
        expect(off < 1e-3, f"the loss of a batch is {whole:.4g}, and {mean:.4g} clip by clip")
        error = batch_error(self._predict()[:1], self._predict(batch=1))
        expect(error < 1e-3, f"predictions change by {error:.2g} with the rest of the batch")

    def training_lowers_the_loss(self) -> None:
        """Train a tiny model so that the loss on other clips falls."""
        model = self._model()
        optimizer: Any = torch.optim.Adam(model.parameters(), 1e-2)
        before = self._objective.loss(model, self._clips(32, seed=500), 1).item()
        for lesson in range(LESSONS):
            optimizer.zero_grad()
            batch = self._clips(16, lesson * 2, draw=lesson * 16)
            loss: Any = self._objective.loss(model, batch, 1)
            loss.backward()
            optimizer.step()
        after = self._objective.loss(model, self._clips(32, seed=500), 1).item()
        expect(after < before, f"the loss goes from {before:.3g} to {after:.3g} in training")

    def keeps_the_given_frames(self) -> None:
        """Predict finite latents of the requested length; 1 or 2 given frames stay unchanged."""
        latents = self._clips().latents
        for known in (1, 2):
            predicted = self._predict(known=known)
            expect_equal("predicts", [*predicted.shape], [*latents.shape])
            expect(predicted.isfinite().all(), "the prediction is not finite")
            same = torch.equal(predicted[:, :known], latents[:, :known])
            expect(same, "the given frames come out changed")

    def heeds_the_number_of_steps(self) -> None:
        """With `steps`, evaluate the network more often for more steps."""
        if self._objective.steps is None:
            raise NotTried("it has no sampling steps")
        few, many = self._predict(steps=1), self._predict(steps=4)
        expect(not torch.equal(few, many), "one step and four give the same prediction")

    def streams_or_refuses_to(self) -> None:
        """Stream finite frames after 1 or 2 given ones, or refuse to with a `RecipeError`."""
        clips, model = self._clips(), self._model()
        latents, conditioning = clips.latents, clips.conditioning
        for known in (1, 2):
            given = latents[:, :known]
            try:
                stream = self._objective.stream(model, given, draws(BATCH), context=FRAMES)
            except RecipeError:
                what = "it refuses to stream, which it says is its default"
                expect(not self._objective.streams_by_default(model), what)
                return
            streamed = played(stream, conditioning, known, FRAMES)
            wanted = [BATCH, FRAMES - known, *latents.shape[2:]]
            expect_equal("a stream gives", [*streamed.shape], wanted)
            expect(streamed.isfinite().all(), "a streamed frame is not finite")


def _part(batch: Batch, clips: slice, known: int) -> Batch:
    """The first `known` latent frames of some clips."""
    actions = batch.conditioning.modulation
    assert actions is not None
    embedded = Conditioning(actions[clips], None, Probe())
    return Batch(batch.latents[clips, :known], embedded, batch.generators[clips])


class TinyDenoiser(Denoiser):
    """Two linear layers per latent pixel, with the mean of all frames so far in between.

    Args:
        inputs: the further inputs that it takes.
    """

    width, layers, heads = WIDTH, 0, 1
    causal = True

    def __init__(self, inputs: Mapping[str, InputKind]) -> None:
        super().__init__()
        self.inputs = inputs
        seen = CHANNELS + 1 + WIDTH
        seen += sum(CHANNELS if kind == "latent" else 1 for kind in inputs.values())
        self.read = nn.Linear(seen, 16)
        self.write = nn.Linear(32, CHANNELS)

    def forward(
        self, latents: Latent, sigma: Sigmas, conditioning: Conditioning, **inputs: Tensor
    ) -> Latent:
        """See `Denoiser.forward`."""
        return self.extend(latents, sigma, conditioning, _Past(10**6), **inputs)

    def new_cache(self, context: int) -> Cache:
        """See `Denoiser.new_cache`."""
        return _Past(context)

    def extend(
        self,
        latents: Latent,
        sigma: Sigmas,
        conditioning: Conditioning,
        cache: Cache,
        **inputs: Tensor,
    ) -> Latent:
        """See `Denoiser.extend`."""
        assert isinstance(cache, _Past)
        assert conditioning.modulation is not None
        told = [latents, sigma[..., None], conditioning.modulation]
        told += [each if each.ndim == 5 else each[..., None] for each in inputs.values()]
        wide = [
            (each if each.ndim == 5 else each[..., None, None].expand(-1, -1, -1, SIDE, SIDE))
            for each in told
        ]
        hidden = torch.tanh(self.read(torch.cat(wide, 2).movedim(2, -1)))
        past = cache.with_past(hidden)
        return self.write(torch.cat([hidden, past], -1)).movedim(-1, 2)


class _Past(Cache):
    """Hidden values of earlier frames."""

    def __init__(self, context: int) -> None:
        super().__init__(context)
        self._kept: Tensor | None = None
        self._all = torch.zeros(0)

    def with_past(self, hidden: Tensor) -> Tensor:
        """The mean of each frame and those before it, `[B, n, h, w, D]`."""
        before = 0 if self._kept is None else self._kept.shape[1]
        self._all = hidden if self._kept is None else torch.cat([self._kept, hidden], 1)
        counts = torch.arange(1, self._all.shape[1] + 1)[:, None, None, None]
        return (self._all.cumsum(1) / counts)[:, before:]

    def keep(self, frames: int) -> None:
        """See `Cache.keep`."""
        before = 0 if self._kept is None else self._kept.shape[1]
        self._kept = self._all[:, : before + frames]
        self.frames += frames


class TinyPredictor(Predictor):
    """Adds a linear map of the actions to the frame before."""

    width, layers, heads = WIDTH, 0, 1
    causal = streams = True

    def __init__(self) -> None:
        super().__init__()
        self.move = nn.Linear(WIDTH, CHANNELS)

    def forward(self, given: Latent, conditioning: Conditioning, frames: int) -> Latent:
        """See `Predictor.forward`."""
        assert conditioning.modulation is not None
        moves = self.move(conditioning.modulation[:, given.shape[1] : frames]).cumsum(1)
        return given[:, -1:] + moves[..., None, None]

    def stream(self, given: Latent, *, context: int) -> LatentStream:
        """See `Predictor.stream`."""
        return _Moved(self, given[:, -1:])


class _Moved(LatentStream):
    def __init__(self, model: TinyPredictor, last: Latent) -> None:
        self._model, self._last = model, last

    def advance(self, conditioning: Conditioning) -> Latent:
        """See `LatentStream.advance`."""
        assert conditioning.modulation is not None
        self._last = self._last + self._model.move(conditioning.modulation[:, -1:])[..., None, None]
        return self._last
