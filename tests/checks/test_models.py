"""Every installed model conforms, and every check of models can fail."""

from dataclasses import replace
from functools import partial
from typing import ClassVar

import pytest
import torch
from torch import nn

from acwm_core.checks import check_model
from acwm_core.checks.model import DenoiserChecks, DynamicsChecks, Probe
from acwm_core.checks.result import checks_of
from acwm_core.checks.trial import TinyDrawer, TinyPredictor
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import CarriedStates, DynamicsModel, Predictor
from acwm_core.model.objectives.next_frame import NextFrame
from acwm_dit.dit import DiT
from acwm_scene.recurrent import RecurrentModel
from acwm_scene.scene import SceneDynamics
from tests.checks.results import Flaws, failures, installed
from tests.checks.toys import SmallUNet
from tests.tiny import PointwiseModel

SMALL = {"width": 32, "layers": 2, "heads": 2}
FLAWS = Flaws(check_model, (*checks_of(DynamicsChecks), *checks_of(DenoiserChecks)))
FLAWS[PointwiseModel] = (
    "depends on the first frame and the actions",
    "ignores the first frame",
)


NETWORKS = {part.target: part for part in installed("model")}
"""Other names are sizes of the same."""


@pytest.mark.parametrize("part", NETWORKS.values(), ids=lambda part: part.name)
def test_installed_models_conform(part):
    """A small one stands for each size."""
    smaller = {name: SMALL[name] for name in part.defaults if name in SMALL}
    assert failures(check_model(part.name, **smaller)) == {}


@pytest.mark.parametrize("inputs", [{}, NextFrame.inputs], ids=["none", "next_frame"])
def test_a_causal_model_conforms(inputs):
    assert failures(check_model(DiT, **SMALL, causal=True, inputs=inputs)) == {}


class Flawed(DiT):
    """A small DiT to spoil."""

    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels, **SMALL)


@FLAWS.caught_by("can be constructed", "heads")
class NoHeads(Flawed):
    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels)
        self.heads = 0


@FLAWS.caught_by("weights can be saved", "_extra_state is a dict")
class MoreThanTensors(Flawed):
    def get_extra_state(self):
        return {"steps": 0}

    def set_extra_state(self, state):
        pass


@FLAWS.caught_by("can be constructed", "the number of widths is 1, not 2")
class OneWidthForTwo(Flawed):
    widths = (32,)


@FLAWS.caught_by("can be constructed", "2 heads do not divide the width 33 of a layer")
class OddWidth(Flawed):
    widths = (32, 33)


@FLAWS.caught_by("keeps the shape", "give a prediction")
class LosesAFrame(Flawed):
    def forward(self, latents, sigma, conditioning):
        return super().forward(latents, sigma, conditioning)[:, 1:]


@FLAWS.caught_by("gradient reaches every parameter", "no gradient reaches spare")
class Idle(Flawed):
    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels)
        self.spare = nn.Linear(2, 2)


@FLAWS.caught_by("elements of a batch are independent", "rest of the batch")
class MixesTheBatch(Flawed):
    def forward(self, latents, sigma, conditioning):
        mixed = latents - latents.mean(0, keepdim=True)
        return super().forward(mixed, sigma, conditioning)


@FLAWS.caught_by("sees latents and noise level", "noise level")
class IgnoresSigma(Flawed):
    def forward(self, latents, sigma, conditioning):
        return super().forward(latents, torch.zeros_like(sigma), conditioning)


@FLAWS.caught_by("is causal if it says so", "before latent frame 1")
class ClaimsToBeCausal(Flawed):
    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels)
        self.causal = True


@FLAWS.caught_by("uses the modulation", "has no effect")
class IgnoresModulation(Flawed):
    def forward(self, latents, sigma, conditioning):
        bare = Conditioning(None, conditioning.context, conditioning.conditioner)
        return super().forward(latents, sigma, bare)


@FLAWS.caught_by("draws from the generators if it says so", "but samples is false")
class SaysThatItIsCertain(Flawed):
    samples = False


def latent_channels(drawing):
    """The class as a recipe builds it."""
    return lambda *, latent_channels: drawing(latent_channels)


def test_a_predictor_that_draws_conforms():
    check = "draws from the generators if it says so"
    results = {result.name: result for result in check_model(latent_channels(TinyDrawer))}
    assert results[check].passed
    assert not results[check].reason  # it was tried


@pytest.mark.parametrize(
    ("draw", "reason"),
    [
        (lambda self, given, generators: 0, "its prediction ignores generators"),
        (lambda self, given, generators: torch.randn(1), "generators do not decide"),
    ],
)
def test_a_predictor_must_draw_from_the_generators(draw, reason):
    flawed = latent_channels(type("Undrawn", (TinyDrawer,), {"draw": draw}))
    found = failures(check_model(flawed))
    assert reason in found["draws from the generators if it says so"]


def test_a_stream_must_keep_the_draw():
    class Forgets(TinyDrawer):
        def stream(self, given, *, context, generators=()):
            return TinyPredictor.stream(self, given, context=context)

    found = failures(check_model(latent_channels(Forgets)))
    assert "its stream ignores generators" in found["draws from the generators if it says so"]


class _Between(Probe):
    """Stands between a model and the conditioner, and does what it is told with some calls.

    Args:
        conditioner: the conditioner.
        instead: for a place, what to do with the tokens instead of asking the conditioner.
    """

    def __init__(self, conditioner, instead):
        super().__init__()
        self.conditioner, self.instead = conditioner, instead

    def _act(self, place, tokens):
        ask = partial(self.conditioner._act, place)
        return self.instead.get(place, lambda ask, tokens: ask(tokens))(ask, tokens)


class Spoilt(Flawed):
    """Does something else than it should at some places where the conditioner acts."""

    instead: ClassVar = {}

    def forward(self, latents, sigma, conditioning):
        between = _Between(conditioning.conditioner, self.instead)
        return super().forward(latents, sigma, replace(conditioning, conditioner=between))


def skips(ask, tokens):
    return tokens


def ignores(ask, tokens):
    ask(tokens)
    return tokens


def cuts(ask, tokens):
    return torch.cat([ask(tokens[..., :16]), tokens[..., 16:]], -1)


def repeats(ask, tokens):
    return ask(ask(tokens))


@FLAWS.caught_by("lets the conditioner act at the input", "it never calls inject_input")
class SkipsTheInput(Spoilt):
    instead: ClassVar = {"input": skips}


@FLAWS.caught_by("lets the conditioner act at the input", "ignores the tokens of inject_input")
class IgnoresTheInput(Spoilt):
    instead: ClassVar = {"input": ignores}


@FLAWS.caught_by("lets the conditioner act at the input", "of the width [16], not [32]")
class NarrowInput(Spoilt):
    instead: ClassVar = {"input": cuts}


@FLAWS.caught_by("lets the conditioner act after every layer", "never calls inject for layer 1")
class SkipsALayer(Spoilt):
    instead: ClassVar = {1: skips}


@FLAWS.caught_by("lets the conditioner act after every layer", "ignores the tokens of inject for")
class IgnoresALayer(Spoilt):
    instead: ClassVar = {0: ignores}


@FLAWS.caught_by("lets the conditioner act after every layer", "of the width [20], not [16]")
class SaysAnotherWidth(SmallUNet):
    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels)
        self.widths = (self.width, 16, self.width)


@FLAWS.caught_by("calls the conditioner once in order", "called at ['input', 0, 0, 1], not")
class CallsTwice(Spoilt):
    instead: ClassVar = {0: repeats}


@FLAWS.caught_by("calls the conditioner once in order", "called at ['input', 0, 1], not")
class CountsALayerTooMany(Flawed):
    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels)
        self.layers = 3


@FLAWS.caught_by("sees its further inputs", "ignores the frame's input previous")
class Forgetful(DiT):
    def __init__(self, *, latent_channels):
        super().__init__(
            latent_channels=latent_channels, **SMALL, causal=True, inputs=NextFrame.inputs
        )

    def forward(self, latents, sigma, conditioning, *, previous, previous_sigma):
        inputs = {"previous": latents, "previous_sigma": previous_sigma}
        return super().forward(latents, sigma, conditioning, **inputs)


class Causal(DiT):
    """One with a cache to spoil."""

    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels, **SMALL, causal=True)


@FLAWS.caught_by("frame by frame it predicts the same", "cached and uncached differ")
class ForgetsThePast(Causal):
    def extend(self, latents, sigma, conditioning, cache):
        return self(latents, sigma, conditioning)


@FLAWS.caught_by("frame by frame it predicts the same", "cached and uncached differ")
class StreamsPastTheConditioner(Causal):
    def extend(self, latents, sigma, conditioning, cache):
        alone = replace(conditioning, conditioner=Probe())
        return super().extend(latents, sigma, alone, cache)


@FLAWS.caught_by("frame by frame it predicts the same", "cached and uncached differ")
class KeepsUnasked(Causal):
    def extend(self, latents, sigma, conditioning, cache):
        predicted = super().extend(latents, sigma, conditioning, cache)
        cache.keep(1)
        return predicted


@FLAWS.caught_by("can be constructed", "neither a Denoiser nor a Predictor")
class OfNoKind(DynamicsModel):
    width, layers, heads = 8, 0, 1

    def __init__(self, *, latent_channels):
        super().__init__()


class Recurrent(RecurrentModel):
    """A small model that does not denoise, to spoil."""

    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels, channels=8, width=16, blocks=1)


@FLAWS.caught_by("gradient reaches every parameter", "reaches spare")
class TrainsNotAll(Recurrent):
    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels)
        self.spare = nn.Linear(2, 2)


@FLAWS.caught_by("names its own matrices", "of shape (16,)")
class NamesVectors(Recurrent):
    def matrices(self):
        return [p for p in self.parameters() if p.shape == (16,)]


@FLAWS.caught_by("names its own matrices", "twice")
class NamesThemTwice(Recurrent):
    def matrices(self):
        return super().matrices() * 2


@FLAWS.caught_by("names its own matrices", "not a parameter of the model")
class NamesCopies(Recurrent):
    def matrices(self):
        return [nn.Parameter(each * 1) for each in super().matrices()]


@FLAWS.caught_by("keeps the given frames", "forward gives the shape [2, 2, 4, 8, 8], not")
class LosesTheLastFrame(Recurrent):
    def forward(self, given, conditioning, frames, generators=()):
        return super().forward(given, conditioning, frames)[:, :-1]


@FLAWS.caught_by("elements of a batch are independent", "rest of the batch")
class StartsAlike(Recurrent):
    def start(self, given, first):
        return super().start(given - given.mean(0, keepdim=True), first)


@FLAWS.caught_by("depends on the first frame and the actions", "ignores the actions")
class ActionInsensitive(Recurrent):
    def actions(self, conditioning):
        return torch.zeros_like(conditioning.modulation)


@FLAWS.caught_by("later actions change nothing if causal", "with the last action")
class LooksAhead(Recurrent):
    def actions(self, conditioning):
        embedded = super().actions(conditioning)
        return embedded + embedded.sum(1, keepdim=True)


@FLAWS.caught_by("streams what it predicts", "differ by")
class ForgetsItsState(Recurrent):
    def next_state(self, state, conditioning):
        latent, moved = super().next_state(state, conditioning)
        return latent + 1, moved


@FLAWS.caught_by("streams what it predicts", "refuses to stream")
class OnlySaysThatItStreams(Recurrent):
    def stream(self, given, *, context, generators=()):
        return Predictor.stream(self, given, context=context)


@FLAWS.caught_by("streams what it predicts", "after 2 given frames")
class StreamsFromTheFirst(Recurrent):
    def stream(self, given, *, context, generators=()):
        return super().stream(given[:, :1], context=context)


class Scene(SceneDynamics):
    """A small model that predicts states, to spoil."""

    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels, channels=8, width=16, blocks=1)
        self.prepare(torch.zeros(1), torch.ones(1))


@FLAWS.caught_by("returns only the frames asked for", "frames that differ by")
class ReturnsTheFirst(Recurrent):
    def forward(self, given, conditioning, frames, generators=()):
        numbers = torch.arange(frames - given.shape[1]).expand(len(given), -1)
        return super().predict_frames(given, conditioning, frames, numbers)

    def predict_frames(self, given, conditioning, frames, numbers, generators=()):
        return super().predict_frames(given, conditioning, frames, 0 * numbers)


@FLAWS.caught_by("predicts states of every frame", "change with the last action")
class KnowsLaterActions(Scene):
    def embed(self, conditioning):
        rows = super().embed(conditioning)
        return {name: each + each[:, -1:] for name, each in rows.items()}


@FLAWS.caught_by("predicts states of every frame", "states of 11 video frames")
class LeavesOutAFrame(Scene):
    def predict_states(self, given, conditioning, frames, generators=()):
        return super().predict_states(given, conditioning, frames, generators)[:, 1:]


@FLAWS.caught_by("predicts states of every frame", "states are infinite")
class Diverges(Scene):
    def predict_states(self, given, conditioning, frames, generators=()):
        return super().predict_states(given, conditioning, frames, generators) / 0


class Carried(CarriedStates):
    """Passes on to the states of a scene, to spoil."""

    def __init__(self, states):
        self._states = states

    @property
    def current(self):
        return self._states.current

    def advance(self, conditioning):
        return self._states.advance(conditioning)

    def picked(self, rows):
        return type(self)(self._states.picked(rows))

    def put(self, rows, others):
        self._states.put(rows, others._states)


@FLAWS.caught_by("carries the states that it predicts", "the carried states differ by")
class Shifts(Scene):
    class Kept(Carried):
        def advance(self, conditioning):
            return super().advance(conditioning) + 1

    def carry_states(self, given, generators=()):
        return self.Kept(super().carry_states(given, generators))


@FLAWS.caught_by("carries the states that it predicts", "not the last of the states")
class StaysBehind(Scene):
    class Kept(Carried):
        @property
        def current(self):
            return super().current + 1

    def carry_states(self, given, generators=()):
        return self.Kept(super().carry_states(given, generators))


@FLAWS.caught_by("carries the states that it predicts", "begins anew differ by")
class NeverBeginsAnew(Scene):
    class Kept(Carried):
        def put(self, rows, others):
            pass

    def carry_states(self, given, generators=()):
        return self.Kept(super().carry_states(given, generators))


@FLAWS.caught_by("carries the states that it predicts", "for who needs the first value alone")
class LeavesOutTheFirst(Scene):
    class Kept(Carried):
        def only(self, columns):
            return Shifts.Kept(self._states)

    def carry_states(self, given, generators=()):
        return self.Kept(super().carry_states(given, generators))
