"""Checks of a planner: what acting with it requires."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from acwm_core.checks.result import Suite, expect, expect_equal, expect_is_a
from acwm_core.model.shapes import Actions
from acwm_planning.planner import Plan, Planner

LOW, HIGH = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 4.0])  # bounds of the test actions
BEST = torch.tensor([0.5, 1.0])  # the action with zero cost


class PlannerChecks(Suite):
    """Checks of an `acwm_planning.planner.Planner` on a quadratic cost with known minimum."""

    kind = "planner"

    @functools.cached_property
    def _planner(self) -> Planner:
        return self.make()

    def _plan(self, seed: int = 0, forbidden: float = 4.0) -> Plan:
        """A first decision; actions above `forbidden` in the second dimension have cost NaN."""

        def cost(actions: Actions) -> Tensor:
            costs = _bowl(actions)
            return torch.where((actions[..., 1] > forbidden).any(1), torch.nan, costs)

        self._planner.reset()
        return self._planner.plan(cost, LOW, HIGH, torch.Generator().manual_seed(seed))

    def plans_actions(self) -> None:
        """Construct the planner and plan actions `[T, A]`, at least `actions_per_plan` of them."""
        expect_is_a(self._planner, Planner)
        plan, count = self._plan(), self._planner.actions_per_plan
        expect_is_a(plan, Plan)
        expect_equal("actions are", plan.actions.ndim, 2)
        expect_equal("an action has", plan.actions.shape[1], len(LOW))
        expect(1 <= count <= len(plan.actions), f"it takes {count} of {len(plan.actions)} actions")
        expect(plan.evaluations > 0, "it reports that it evaluated no cost")

    def actions_lie_within_their_bounds(self) -> None:
        """Keep every action finite and within the bounds."""
        actions = self._plan().actions
        expect(((actions >= LOW) & (actions <= HIGH)).all(), "an action is outside its bounds")

    def plans_cost_less_than_chance(self) -> None:
        """Find a plan of lower cost than three quarters of random plans."""
        plan = self._plan()
        generator = torch.Generator().manual_seed(1)
        shares = torch.rand(256, *plan.actions.shape, generator=generator)
        chance = _bowl(LOW + shares * (HIGH - LOW)).quantile(0.25).item()
        cost = _bowl(plan.actions[None]).item()
        expect(cost < chance, f"its plan costs {cost:.3g}, a random one {chance:.3g}")

    def repeats_itself(self) -> None:
        """Give the same plan again after a reset, with the same generator."""
        first, again = self._plan(seed=5), self._plan(seed=5)
        same = torch.equal(first.actions, again.actions)
        expect(same, "the same problem and generator give another plan")

    def costs_that_are_no_numbers_are_worst(self) -> None:
        """Plan around actions whose cost is NaN."""
        plan = self._plan(forbidden=3.9)
        expect((plan.actions[:, 1] <= 3.9).all(), "it plans actions whose cost is NaN")
        expect(torch.tensor(plan.cost).isfinite(), f"it expects a cost of {plan.cost}")


def _bowl(actions: Actions) -> Tensor:
    """The mean squared distance from the best actions, `[N]`."""
    return (actions - BEST).square().mean((1, 2))


check_planner = PlannerChecks.check
