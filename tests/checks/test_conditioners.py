"""Every installed conditioner conforms and fits every model; every check can fail."""

import itertools

import pytest
import torch
from torch import nn

from acwm_core.checks import check_conditioner
from acwm_core.checks.conditioner import ConditionerChecks
from acwm_core.checks.result import checks_of
from acwm_core.errors import RecipeError
from acwm_core.model.batch import Batch
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.dynamics import Denoiser
from acwm_core.model.objectives.full_sequence import FullSequence
from acwm_core.model.objectives.regression import Regression
from acwm_dit.adaln import AdaLN
from tests.checks.results import Flaws, failures, installed
from tests.checks.toys import AtTheInput, OneWidth
from tests.tiny import SumConditioner

SMALL = {"width": 32, "layers": 2, "heads": 2}
FLAWS = Flaws(check_conditioner, checks_of(ConditionerChecks))

MODELS = installed("model")
CONDITIONERS = installed("conditioner")


@pytest.mark.parametrize("part", CONDITIONERS, ids=lambda part: part.name)
def test_installed_conditioners_conform(part):
    assert failures(check_conditioner(part.name)) == {}


def test_the_smallest_conditioner_conforms():
    assert failures(check_conditioner(SumConditioner)) == {}


@pytest.mark.parametrize(
    ("model", "conditioner"),
    list(itertools.product(MODELS, CONDITIONERS)),
    ids=lambda part: part.name,
)
def test_any_conditioner_drives_any_model(model, conditioner):
    smaller = {name: SMALL[name] for name in model.defaults if name in SMALL}
    network = model.create(latent_channels=4, **smaller)
    embed = conditioner.create(
        action_size=2,
        temporal_stride=4,
        width=network.width,
        layers=network.layers,
        heads=network.heads,
    )
    with torch.no_grad():
        for parameter in [*network.parameters(), *embed.parameters()]:
            parameter.add_(torch.randn_like(parameter), alpha=0.05)
        denoises = isinstance(network, Denoiser)
        objective = FullSequence(prediction="clean", steps=2) if denoises else Regression()
        given, embedded = torch.randn(1, 1, 4, 8, 8), [embed(torch.rand(1, 9, 2)) for _ in range(2)]
        if not network.layers and embedded[0].modulation is None:
            with pytest.raises(RecipeError, match="set conditioner="):
                objective.predict(network, Batch(given, embedded[0], []), 3)
            return
        one, other = (
            objective.predict(network, Batch(given, each, [torch.Generator().manual_seed(0)]), 3)
            for each in embedded
        )
    assert one.shape == (1, 3, 4, 8, 8)
    assert not torch.allclose(one[:, 1:], other[:, 1:])


@FLAWS.caught_by("embeds actions", "neither modulation nor context")
class Empty(Conditioner):
    def __init__(self, **fitted):
        super().__init__()

    def forward(self, actions):
        return Conditioning(None, None, self)


@FLAWS.caught_by("embeds actions", "another conditioner")
class PointsElsewhere(AdaLN):
    def forward(self, actions):
        return Conditioning(super().forward(actions).modulation, None, Empty())


@FLAWS.caught_by("shapes follow the length", "modulation is")
class OneForAll(AdaLN):
    def forward(self, actions):
        modulation = super().forward(actions).modulation
        return Conditioning(modulation[:, :1], None, self)


@FLAWS.caught_by("tokens keep their shape", "come back")
class DropsTokens(AdaLN):
    def inject(self, layer, tokens, conditioning):
        return tokens[:, :, :-1]


@FLAWS.caught_by("tokens keep their shape", "come back")
class DropsTokensAtTheInput(AdaLN):
    def inject_input(self, tokens, conditioning):
        return tokens[:, :, :-1]


@FLAWS.caught_by("fits layers of different widths", "unexpected keyword argument 'widths'")
class KnowsOneWidth(OneWidth):
    pass


@FLAWS.caught_by("fits layers of different widths", "come back [1, 4, 5, 16], not [1, 4, 5, 24]")
class TakesWidthsInVain(AdaLN):
    def __init__(self, *, widths=None, **fitted):
        super().__init__(**fitted)

    def inject(self, layer, tokens, conditioning):
        return tokens[..., :16]


@FLAWS.caught_by("every action counts", "action 1 has no effect")
class EveryOtherAction(AdaLN):
    def forward(self, actions):
        kept = actions.clone()
        kept[:, 1::2] = 0
        return super().forward(kept)


@FLAWS.caught_by("later actions have no effect", "acts later")
class LooksAhead(AdaLN):
    def forward(self, actions):
        modulation = super().forward(actions).modulation
        return Conditioning(modulation + modulation.mean(1, keepdim=True), None, self)


@FLAWS.caught_by("later actions have no effect", "acts later")
class LooksAheadAtTheInput(AtTheInput):
    def inject_input(self, tokens, conditioning):
        return tokens + conditioning.context.mean(1, keepdim=True)


@FLAWS.caught_by("clips of a batch are independent", "rest of the batch")
class MixesTheBatch(AdaLN):
    def forward(self, actions):
        modulation = super().forward(actions).modulation
        return Conditioning(modulation - modulation.mean(0, keepdim=True), None, self)


@FLAWS.caught_by("gradient reaches every parameter", "no gradient reaches spare")
class Idle(AdaLN):
    def __init__(self, **fitted):
        super().__init__(**fitted)
        self.spare = nn.Linear(2, 2)


@FLAWS.caught_by("recent actions suffice if it says so", "without the actions before its 1 latent")
class Forgetful(SumConditioner):
    history = 1


def test_the_published_embedding_is_known_to_look_ahead():
    found = failures(check_conditioner("adaln", embedding="convolutional"))
    assert list(found) == ["later actions have no effect"]
