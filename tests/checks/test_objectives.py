"""Every installed objective conforms, and every check of objectives can fail."""

import pytest
import torch

from acwm_core.checks import check_objective
from acwm_core.checks.objective import ObjectiveChecks
from acwm_core.checks.result import checks_of
from acwm_core.errors import RecipeError
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.objectives.next_frame import NextFrame
from acwm_core.model.objectives.regression import Regression
from tests.checks.results import Flaws, failures, installed

FLAWS = Flaws(check_objective, checks_of(ObjectiveChecks))


@pytest.mark.parametrize(
    "part",
    [
        pytest.param(part, id=part.name, marks=[pytest.mark.ci] * (part.name == "scene"))
        for part in installed("objective")
    ],
)
def test_installed_objectives_conform(part):
    assert failures(check_objective(part.name)) == {}


def test_parameters_are_those_of_the_objective():
    assert failures(check_objective(NextFrame, own_past=0.5, prediction="clean")) == {}


class Flawed(DiffusionForcing):
    """A small one to spoil."""

    def __init__(self):
        super().__init__(prediction="clean", loss_on="clean", weighting="none", steps=2)


@FLAWS.caught_by("can be constructed", "trains is")
class TrainsNothing(Flawed):
    trains = torch.nn.Linear


@FLAWS.caught_by("can be constructed", "neither 'latent' nor 'level'")
class AsksForPixels(Flawed):
    inputs = {"frame": "pixels"}  # noqa: RUF012


@FLAWS.caught_by("takes only models that it can train", "accepts a TinyPredictor")
class TakesAnyModel(Flawed):
    def check_model(self, model):
        return None


@FLAWS.caught_by("the loss is a finite number", "the loss is")
class LossOfEachClip(Flawed):
    def loss(self, *given):
        return super().loss(*given).repeat(2)


@FLAWS.caught_by("the loss is a finite number", "no gradient")
class Detached(Flawed):
    def loss(self, *given):
        return super().loss(*given).detach()


@FLAWS.caught_by("all randomness comes from the generators", "the loss depends on torch's own")
class DrawsForItself(Flawed):
    def draw(self, frames, generator):
        return torch.randint(1000, (frames,))


@FLAWS.caught_by("all randomness comes from the generators", "predictions depend on torch's own")
class SamplesForItself(Flawed):
    def sample(self, evaluate, noise, given, steps=None):
        return super().sample(evaluate, torch.randn_like(noise), given, steps)


@FLAWS.caught_by("clips of a batch are independent", "clip by clip")
class SumsClips(Flawed):
    def loss(self, model, batch, known):
        return super().loss(model, batch, known) * len(batch.latents)


@FLAWS.caught_by("clips of a batch are independent", "with the rest of the batch")
class MixesTheBatch(Flawed):
    def sample(self, evaluate, noise, given, steps=None):
        return super().sample(evaluate, noise - noise.mean(0), given, steps)


@FLAWS.caught_by("training lowers the loss", "the loss goes from")
class Unlearns(Flawed):
    def loss(self, *given):
        loss = super().loss(*given)
        return 2 * loss.detach() - loss


@FLAWS.caught_by("weights count", "the weighed loss is")
class WeighsNothing(Flawed):
    def error(self, evaluate, clean, generators, known=1, weights=None):
        return super().error(evaluate, clean, generators, known)


@FLAWS.caught_by("keeps the given frames", "come out changed")
class ChangesTheGiven(Flawed):
    def predict(self, *given):
        return super().predict(*given) + 1


@FLAWS.caught_by("heeds the number of steps", "the same prediction")
class AlwaysOneStep(Flawed):
    def sample(self, evaluate, noise, given, steps=None):
        return super().sample(evaluate, noise, given, 1)


@FLAWS.caught_by("draws from the generators if it says so", "ignores generators")
class OneNoiseForAll(Flawed):
    def sample(self, evaluate, noise, given, steps=None):
        return super().sample(evaluate, torch.zeros_like(noise), given, steps)


@FLAWS.caught_by("streams or refuses to", "says is its default")
class OnlySaysThatItStreams(Regression):
    def stream(self, model, given, generators, *, steps=None, context):
        raise RecipeError("not today")


@FLAWS.caught_by("streams or refuses to", "a stream gives")
class StreamsInPairs(Regression):
    def stream(self, model, given, generators, *, steps=None, context):
        stream = super().stream(model, given, generators, steps=steps, context=context)
        advance = stream.advance
        stream.advance = lambda conditioning: advance(conditioning).repeat(1, 2, 1, 1, 1)
        return stream
