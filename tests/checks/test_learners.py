"""The checks of learners, on those that are installed and on flawed ones."""

import pytest
import torch
from torch import nn

from acwm_core.checks.result import checks_of
from acwm_policy.backprop import Backprop
from acwm_policy.checks import LearnerChecks, check_learner
from tests.checks.results import Flaws, failures, installed

FLAWS = Flaws(check_learner, checks_of(LearnerChecks))


@pytest.mark.ci
@pytest.mark.parametrize("component", installed("learner"), ids=lambda each: each.name)
def test_installed_learners_conform(component):
    assert failures(check_learner(component.name)) == {}


class Small(Backprop):
    """A sound one."""

    def __init__(self):
        super().__init__(net_arch=(32,), horizon=4, critic_rounds=1, learning_rate=4e-3)


@FLAWS.caught_by("learns a policy", "it counts 0")
class Forgetful(Small):
    def learn(self, steps, report):
        super().learn(steps, report)
        self.steps = 0


@FLAWS.caught_by("actions lie within their bounds", "an action is")
class Unbounded(Small):
    def network(self):
        return super().network()[:-1]


@FLAWS.caught_by("actions lie within their bounds", "not finite")
class Diverges(Small):
    def learn(self, steps, report):
        super().learn(steps, report)
        self._actor[0].weight.data[0, 0] = torch.nan


@FLAWS.caught_by("decides by its seed", "another seed gives the same")
class Stubborn(Small):
    def begin(self, lesson, seed):
        super().begin(lesson, 0)


@FLAWS.caught_by("decides by its seed", "the same seed gives another")
class Restless(Small):
    def _explore(self, vectors):
        self._random.manual_seed(torch.seed() % 2**31)
        return super()._explore(vectors)


@FLAWS.caught_by("resumes exactly", "learns another policy")
class LosesItsOptimiser(Small):
    def restore(self, state):
        super().restore(state)
        for optimiser in (self._climbing, self._judging):
            optimiser.state.clear()


@FLAWS.caught_by("learns to come closer", "of the distance of the start")
class Lazy(Small):
    def network(self):
        still = nn.Linear(6, 2)
        nn.init.zeros_(still.weight)
        return nn.Sequential(still, nn.Tanh())
