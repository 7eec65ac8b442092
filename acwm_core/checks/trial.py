"""Test material for the checks: episodes, synthetic clips and latents, tiny models, a probe."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor, nn

from acwm_core.checks.result import NotTried, Suite, expect, expect_equal, expect_is_a
from acwm_core.data.simulate import simulate
from acwm_core.env.environment import Environment, EnvironmentCard
from acwm_core.env.episode import Episode, EpisodeSpec, Split
from acwm_core.errors import RecipeError
from acwm_core.model.batch import Batch, noise_of_clips
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.dynamics import (
    Cache,
    Denoiser,
    DynamicsModel,
    InputKind,
    LatentStream,
    Predictor,
)
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.objectives.flow import evaluation
from acwm_core.model.objectives.objective import Objective
from acwm_core.model.shapes import Actions, Latent, Sigmas, Tokens, Video

Module = TypeVar("Module", bound=nn.Module)

SMALL = 64
"""Frame height at which episodes are simulated, if the aspect ratio allows it."""

BEGINNING = 32
"""Number of frames of episodes that are simulated repeatedly, if the horizon is longer."""

WIDTH = 4
"""Width of the tiny models, and so of the modulation that they take."""

Place = int | Literal["input"]
"""Where a conditioner acts: before the first layer, or after the layer of this number."""


class EnvironmentTrial(Suite):
    """An environment, which must accept `size`, and its episodes, simulated on first use."""

    kind = "environment"

    @functools.cached_property
    def size(self) -> tuple[int, int]:
        """The smallest frame size with the card's aspect ratio and a height of at least `SMALL`."""
        height, width = self.make().card.frame_size
        fit = (small for small in range(SMALL, height, 8) if small * width % (8 * height) == 0)
        small = next(fit, height)
        return small, small * width // height

    @functools.cached_property
    def environment(self) -> Environment:
        """The environment at the small size."""
        return self.make(size=self.size)

    @property
    def card(self) -> EnvironmentCard:
        """The environment's card."""
        return self.environment.card

    @functools.cached_property
    def episode(self) -> Episode:
        """Training episode 0, run with the environment's policy."""
        return simulate(self.environment, self.spec())

    @functools.cached_property
    def beginning(self) -> Episode:
        """The first `BEGINNING` frames of `episode`, simulated on their own."""
        return simulate(self.environment, self.spec(), frames=BEGINNING)

    def spec(self, split: Split = "train", index: int = 0) -> EpisodeSpec:
        """The spec of an episode of this environment."""
        return EpisodeSpec(self.card.name, split, index)


def moving_discs(batch: int, frames: int, height: int, width: int, seed: int = 0) -> Video:
    """Coloured discs that move over a shaded background, different ones in each clip of a batch."""
    generator = torch.Generator().manual_seed(seed)
    y = torch.linspace(0, 1, height)[:, None]
    x = torch.linspace(0, 1, width)
    shade = (0.35 + 0.4 * y + 0.15 * x).expand(batch, frames, 3, height, width)
    video = shade * torch.tensor([1.0, 0.95, 0.85])[:, None, None]
    time = torch.arange(frames)[:, None, None, None] / 16
    for _ in range(3):
        start_x, start_y, turn, *colour = torch.rand(6, batch, 1, 1, 1, 1, generator=generator)
        centre_x = 0.5 + 0.35 * torch.sin(2 * math.pi * (start_x + time * (0.3 + turn)))
        centre_y = 0.5 + 0.35 * torch.cos(2 * math.pi * (start_y + time * (0.3 + turn)))
        distance = torch.hypot(x - centre_x, y - centre_y)
        covered = ((0.12 - distance) * max(height, width) + 0.5).clamp(0, 1)
        video = video + covered * (torch.cat(colour, dim=2) - video)
    return video


def shaken(module: Module) -> Module:
    """Add noise to every parameter in place, so that none is exactly zero; returns the module."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=0.05)
    return module


def noise(shape: Sequence[int], seed: int) -> Tensor:
    """Normally distributed numbers that depend only on shape and seed."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def without_gradient(module: nn.Module, output: Tensor) -> list[str]:
    """Names of trainable parameters that get no gradient from a random loss on `output`."""
    loss = (output * noise(output.shape, seed=0)).sum()
    named = {name: p for name, p in module.named_parameters() if p.requires_grad}
    gradients = torch.autograd.grad(loss, list(named.values()), materialize_grads=True)
    return [name for name, gradient in zip(named, gradients, strict=True) if not gradient.any()]


def batch_error(first: Tensor, second: Tensor) -> float:
    """Largest absolute difference, relative to the largest value in `first` (at least 1)."""
    scale = max(1.0, first.abs().max().item())
    return (first - second).abs().max().item() / scale


def draws(batch: int, first: int = 0) -> list[torch.Generator]:
    """A generator for each of `batch` clips, of which the first has the number `first`."""
    return [torch.Generator().manual_seed(first + clip) for clip in range(batch)]


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
        return Conditioning(None, None, self)

    def inject_input(self, tokens: Tokens, conditioning: Conditioning) -> Tokens:
        return self._act("input", tokens)

    def inject(self, layer: int, tokens: Tokens, conditioning: Conditioning) -> Tokens:
        return self._act(layer, tokens)

    def _act(self, place: Place, tokens: Tokens) -> Tokens:
        width = tokens.shape[-1]
        self.called.append((place, width))
        return tokens + noise((width,), seed=5) if place in self.changed else tokens


def probed(modulation: Tensor, probe: Probe | None = None) -> Conditioning:
    """The conditioning with this modulation `[B, L, D]` and no context."""
    return Conditioning(modulation, None, probe or Probe())


def batch_of(
    latents: Latent, modulation: Tensor, probe: Probe | None = None, first: int = 0
) -> Batch:
    """Clips, of which the first has the number `first` and so its noise."""
    return Batch(latents, probed(modulation, probe), draws(len(latents), first))


class PredictionTrial(Suite):
    """A model and an objective, which predict latents together; what both are checked for."""

    @functools.cached_property
    def _objective(self) -> Objective[Any]:
        raise NotImplementedError

    @functools.cached_property
    def _model(self) -> DynamicsModel:
        raise NotImplementedError

    def _inputs(self) -> tuple[Latent, Tensor]:
        """Latents `[B, L, C, h, w]` and modulation `[B, L, D]`."""
        raise NotImplementedError

    @torch.no_grad()
    def _predict(
        self,
        given: Latent,
        modulation: Tensor,
        probe: Probe | None = None,
        steps: int | None = None,
        first: int = 0,
    ) -> Latent:
        """Predict clips as long as the modulation, with the noise of clip number `first` and on."""
        clips, frames = batch_of(given, modulation, probe, first), modulation.shape[1]
        return self._objective.predict(self._model, clips, frames, steps)

    @torch.no_grad()
    def _streamed(self, known: int, first: int = 0) -> Latent:
        """The frames of a stream after `known` given ones; not tried if it refuses to stream."""
        latents, modulation = self._inputs()
        given, frames, objective = latents[:, :known], latents.shape[1], self._objective
        try:
            noises = draws(len(given), first)
            stream = objective.stream(self._model, given, noises, context=frames)
        except RecipeError as error:
            default = objective.streams_by_default(self._model)
            expect(not default, "it refuses to stream, which it says is its default")
            raise NotTried(str(error)) from None
        seen = [0, *range(known, frames - 1)]  # the first call covers all given frames
        ends, conditioning = range(known + 1, frames + 1), probed(modulation)
        steps = [conditioning.frames(*span) for span in zip(seen, ends, strict=True)]
        streamed = torch.cat([stream.advance(step) for step in steps], 1)
        wanted = [len(given), frames - known, *latents.shape[2:]]
        expect_equal("a stream gives", [*streamed.shape], wanted)
        expect(streamed.isfinite().all(), "a streamed frame is not finite")
        return streamed

    def keeps_the_given_frames(self) -> None:
        """Predict finite latents of the requested length; 1 or 2 given frames stay unchanged."""
        latents, modulation = self._inputs()
        for known in (1, 2):
            given = latents[:, :known]
            predicted = self._predict(given, modulation)
            expect_equal("predicts", [*predicted.shape], [*latents.shape])
            expect(predicted.isfinite().all(), "the prediction is not finite")
            expect(torch.equal(predicted[:, :known], given), "the given frames come out changed")

    def draws_from_the_generators_if_it_says_so(self) -> None:
        """Predict and stream the same with the same generators; with others iff not `samples`."""
        latents, modulation = self._inputs()
        seeds, samples = (0, 0, 100), self._model.samples
        expect_is_a(samples, bool)
        results = {
            "prediction": [self._predict(latents[:, :1], modulation, first=s) for s in seeds]
        }
        with contextlib.suppress(NotTried):
            results["stream"] = [self._streamed(1, first=s) for s in seeds]
        for what, (once, again, other) in results.items():
            expect(torch.equal(once, again), f"generators do not decide its {what}")
            same = torch.equal(once, other)
            expect(not (same and samples), f"its {what} ignores generators, but samples is true")
            expect(same or samples, f"its {what} depends on generators, but samples is false")


class DenoisingTrial(DiffusionForcing):
    """Trains and samples any denoiser; its further inputs are noise that is always the same."""

    causal = False

    def loss(self, model: Denoiser, batch: Batch, known: int) -> Tensor:
        inputs = further_inputs(model, *batch.latents.shape)
        evaluate = evaluation(model, batch.conditioning, **inputs)
        return self.error(evaluate, batch.latents, batch.generators, known)

    def predict(
        self, model: Denoiser, given: Batch, frames: int, steps: int | None = None
    ) -> Latent:
        batch, _, *size = given.latents.shape
        inputs = further_inputs(model, batch, frames, *size)
        evaluate = evaluation(model, given.conditioning, **inputs)
        return self.sample(evaluate, given.noise(frames), given.latents, steps)


def further_inputs(model: Denoiser, batch: int, frames: int, *size: int) -> dict[str, Tensor]:
    """Random further inputs of a denoiser, the same for all elements of a batch."""
    shapes = {"latent": (1, frames, *size), "level": (1, frames)}
    inputs = {name: noise(shapes[kind], seed=6) for name, kind in model.inputs.items()}
    return {
        name: (values.sigmoid() if values.ndim == 2 else values).expand(batch, *values.shape[1:])
        for name, values in inputs.items()
    }


class TinyDenoiser(Denoiser):
    """Two linear layers per latent pixel, with the mean of all frames so far in between.

    Args:
        channels: channels C of the latents.
        inputs: the further inputs that it takes.
    """

    width, layers, heads = WIDTH, 0, 1
    causal = True

    def __init__(self, channels: int, inputs: Mapping[str, InputKind]) -> None:
        super().__init__()
        self.inputs = inputs
        further = sum(channels if kind == "latent" else 1 for kind in inputs.values())
        self.read = nn.Linear(channels + 1 + WIDTH + further, 16)
        self.write = nn.Linear(32, channels)

    def forward(
        self, latents: Latent, sigma: Sigmas, conditioning: Conditioning, **inputs: Tensor
    ) -> Latent:
        return self.extend(latents, sigma, conditioning, _Past(2), **inputs)

    def new_cache(self, context: int) -> Cache:
        return _Past(context)

    def extend(
        self,
        latents: Latent,
        sigma: Sigmas,
        conditioning: Conditioning,
        cache: Cache,
        **inputs: Tensor,
    ) -> Latent:
        assert isinstance(cache, _Past)
        assert conditioning.modulation is not None
        parts = [latents, sigma[..., None], conditioning.modulation]
        parts += [part if part.ndim == 5 else part[..., None] for part in inputs.values()]
        size = latents.shape[3:]
        wide = [
            part if part.ndim == 5 else part[..., None, None].expand(-1, -1, -1, *size)
            for part in parts
        ]
        hidden = torch.tanh(self.read(torch.cat(wide, 2).movedim(2, -1)))
        return self.write(torch.cat([hidden, cache.means(hidden)], -1)).movedim(-1, 2)


class _Past(Cache):
    """Hidden values of all earlier frames, whatever the context."""

    frames: int

    def __init__(self, context: int) -> None:
        super().__init__(context)
        self._kept: list[Tensor] = []
        self._all = torch.zeros(0)

    def means(self, hidden: Tensor) -> Tensor:
        """The mean of each frame and those before it, `[B, n, h, w, D]`."""
        self._all = torch.cat([*self._kept, hidden], 1)
        counts = torch.arange(1, self._all.shape[1] + 1)[:, None, None, None]
        return (self._all.cumsum(1) / counts)[:, self.frames :]

    def keep(self, frames: int) -> None:
        self.frames += frames
        self._kept = [self._all[:, : self.frames]]


class TinyPredictor(Predictor):
    """Adds a linear map of the actions to the frame before.

    Args:
        channels: channels C of the latents.
    """

    width, layers, heads = WIDTH, 0, 1
    causal = True

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.move = nn.Linear(WIDTH, channels)

    def forward(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[torch.Generator] = (),
    ) -> Latent:
        assert conditioning.modulation is not None
        moves = self.move(conditioning.modulation[:, given.shape[1] : frames]).cumsum(1)
        return given[:, -1:] + moves[..., None, None]

    def stream(
        self, given: Latent, *, context: int, generators: Sequence[torch.Generator] = ()
    ) -> LatentStream:
        return _Moved(self.move, given[:, -1:])


class TinyDrawer(TinyPredictor):
    """Adds noise of a learnt size to all frames, the same in each."""

    samples = True

    def __init__(self, channels: int) -> None:
        super().__init__(channels)
        self.size = nn.Parameter(torch.ones(()))

    def forward(
        self,
        given: Latent,
        conditioning: Conditioning,
        frames: int,
        generators: Sequence[torch.Generator] = (),
    ) -> Latent:
        return super().forward(given, conditioning, frames) + self.draw(given, generators)

    def stream(
        self, given: Latent, *, context: int, generators: Sequence[torch.Generator] = ()
    ) -> LatentStream:
        return super().stream(given + self.draw(given, generators), context=context)

    def draw(self, given: Latent, generators: Sequence[torch.Generator]) -> Latent:
        """What is added, `[B, 1, C, h, w]`."""
        return self.size * noise_of_clips((1, *given.shape[2:]), generators)


class _Moved(LatentStream):
    def __init__(self, move: nn.Linear, last: Latent) -> None:
        self._move, self._last = move, last

    def advance(self, conditioning: Conditioning) -> Latent:
        assert conditioning.modulation is not None
        self._last = self._last + self._move(conditioning.modulation[:, -1:])[..., None, None]
        return self._last
