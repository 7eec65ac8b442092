"""Every installed model conforms, and every check of models can fail."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from acwm_core.checks import check_model
from acwm_core.checks.dynamics import DynamicsChecks
from acwm_core.checks.model import DenoiserChecks
from acwm_core.checks.result import checks_of
from acwm_core.conditioner import Conditioning
from acwm_core.dynamics import DynamicsModel
from acwm_dit.dit import DiT
from acwm_recurrent.recurrent import RecurrentModel
from tests.checks.results import Flaws, failures, installed
from tests.core.tiny import PointwiseModel

SMALL = {"width": 32, "layers": 2, "heads": 2}
FLAWS = Flaws(check_model, (*checks_of(DynamicsChecks), *checks_of(DenoiserChecks)))
FLAWS[PointwiseModel] = (
    "depends on the first frame and the actions",
    "ignores the first frame",
)


@pytest.mark.parametrize("part", installed("model"), ids=lambda part: part.name)
def test_installed_models_conform(part):
    """Sizes are presets of one network, so a small one stands for each."""
    smaller = {name: SMALL[name] for name in part.defaults if name in SMALL}
    assert failures(check_model(part.name, **smaller)) == {}


@pytest.mark.parametrize("previous", [False, True], ids=["diffusion_forcing", "next_frame"])
def test_a_causal_model_conforms(previous):
    assert failures(check_model(DiT, **SMALL, causal=True, previous=previous)) == {}


class Flawed(DiT):
    """A small DiT to spoil."""

    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels, **SMALL)


@FLAWS.caught_by("can be constructed", "heads")
class NoHeads(Flawed):
    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels)
        self.heads = 0


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


@FLAWS.caught_by("calls the conditioner after every layer", "ignores the tokens")
class IgnoresInjection(Flawed):
    def forward(self, latents, sigma, conditioning):
        for layer in range(self.layers):
            conditioning.inject(
                layer, latents.flatten(3).transpose(2, 3)[..., :1].expand(-1, -1, -1, self.width)
            )
        return super().forward(
            latents, sigma, Conditioning(conditioning.modulation, None, _Silent())
        )


@FLAWS.caught_by("calls the conditioner after every layer", "inject is called for layers")
class CallsOnlyOnce(Flawed):
    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels)
        self.layers = 3  # one more than there are


@FLAWS.caught_by("sees the frame before if it says so", "ignores the latents of the one before")
class Forgetful(DiT):
    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels, **SMALL, causal=True, previous=True)

    def forward(self, latents, sigma, conditioning):
        return super().forward(latents, sigma, replace(conditioning, previous=None))


class Causal(DiT):
    """One with a cache to spoil."""

    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels, **SMALL, causal=True)


@FLAWS.caught_by("frame by frame it predicts the same", "cached and uncached differ")
class ForgetsThePast(Causal):
    def extend(self, latents, sigma, conditioning, cache):
        return self(latents, sigma, conditioning)


@FLAWS.caught_by("frame by frame it predicts the same", "cached and uncached differ")
class KeepsUnasked(Causal):
    def extend(self, latents, sigma, conditioning, cache):
        predicted = super().extend(latents, sigma, conditioning, cache)
        cache.keep(1)
        return predicted


class Recurrent(RecurrentModel):
    """A small model that does not denoise, to spoil."""

    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels, channels=8, width=16, blocks=1)


@FLAWS.caught_by("gradient reaches every parameter", "reaches spare")
class TrainsNotAll(Recurrent):
    def __init__(self, *, latent_channels):
        super().__init__(latent_channels=latent_channels)
        self.spare = nn.Linear(2, 2)


@FLAWS.caught_by("keeps the given frames", "come out changed")
class PredictsTheGiven(Recurrent):
    def predict(self, given, conditioning, frames, generators, steps=None):
        return super().predict(given, conditioning, frames, generators, steps) + 1


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
    def frame(self, state):
        return super().frame(state) + 1


@FLAWS.caught_by("streams what it predicts", "refuses to stream")
class OnlySaysThatItStreams(Recurrent):
    def stream(self, given, generators, *, steps=None, context):
        return DynamicsModel.stream(self, given, generators, steps=steps, context=context)


@FLAWS.caught_by("streams what it predicts", "after 2 given frames")
class StreamsFromTheFirst(Recurrent):
    def stream(self, given, generators, *, steps=None, context):
        return super().stream(given[:, :1], generators, steps=steps, context=context)


class _Silent:
    def inject(self, layer, tokens, conditioning):
        return tokens
