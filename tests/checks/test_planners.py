"""The checks of planners, on those that are installed and on flawed ones."""

import pytest
import torch

from acwm_core.checks.result import checks_of
from acwm_planning.checks import PlannerChecks, check_planner
from acwm_planning.planner import Plan, Planner
from tests.checks.results import Flaws, failures, installed

FLAWS = Flaws(check_planner, checks_of(PlannerChecks))


@pytest.mark.parametrize("component", installed("planner"), ids=lambda each: each.name)
def test_installed_planners_conform(component):
    assert failures(check_planner(component.name)) == {}


class Shooting(Planner):
    """The best of 256 random plans of three actions."""

    actions_per_plan = 1

    def reset(self):
        self.decisions = 0

    def draw(self, low, high, rng):
        return low + torch.rand(256, 3, len(low), generator=rng) * (high - low)

    def plan(self, cost, low, high, rng):
        actions = self.draw(low, high, rng)
        costs = cost(actions).nan_to_num(torch.inf)
        best = int(costs.argmin())
        return Plan(actions[best], float(costs[best]), len(actions))


def test_a_sound_one_conforms():
    assert failures(check_planner(Shooting)) == {}


@FLAWS.caught_by("plans actions", "it takes 4 of 3 actions")
class Greedy(Shooting):
    actions_per_plan = 4


@FLAWS.caught_by("actions lie within their bounds", "outside its bounds")
class Unbounded(Shooting):
    def plan(self, cost, low, high, rng):
        plan = super().plan(cost, low, high, rng)
        return Plan(plan.actions - 5, plan.cost, plan.evaluations)


@FLAWS.caught_by("plans cost less than chance", "a random one")
class Pessimist(Shooting):
    def plan(self, cost, low, high, rng):
        return super().plan(lambda actions: -cost(actions), low, high, rng)


@FLAWS.caught_by("repeats itself", "another plan")
class Restless(Shooting):
    def draw(self, low, high, rng):
        return super().draw(low, high, torch.Generator().manual_seed(torch.seed() % 2**31))


@FLAWS.caught_by("costs that are no numbers are worst", "whose cost is NaN")
class Fearless(Shooting):
    def plan(self, cost, low, high, rng):
        return super().plan(lambda actions: -cost(actions).nan_to_num(torch.inf), low, high, rng)
