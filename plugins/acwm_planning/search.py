"""What all planners of this package share: actions in blocks, bounds, a count, and the best."""

from __future__ import annotations

import math
from abc import abstractmethod

import torch
from torch import Tensor

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.planning.planner import Plan, Planner, RolloutCost
from acwm_core.shapes import Actions

LEAST = 0.02
"""Standard deviation at least of what is searched, where the bounds are -1 and 1."""


class Search:
    """A cost of blocks `[N, H, A]` in [-1, 1], that remembers the best and counts what it is asked.

    Args:
        cost: of raw actions.
        low, high: bounds `[A]` of raw actions, which become -1 and 1.
        action_block: actions that each block repeats.

    Attributes:
        best: the cheapest blocks so far, `[H, A]`; None before any had a cost.
        least: what they cost.
        evaluations: candidates so far.
    """

    def __init__(self, cost: RolloutCost, low: Tensor, high: Tensor, action_block: int) -> None:
        self._cost, self._low, self._high, self._block = cost, low, high, action_block
        self.best: Tensor | None = None
        self.least, self.evaluations = math.inf, 0

    def __call__(self, blocks: Tensor) -> Tensor:
        """Costs `[N]`; one that is NaN is infinite here, so that no comparison prefers it.

        Raises:
            ShapeError: the cost gives other than a number per candidate.
        """
        costs = self._cost(self.actions(blocks))
        if costs.shape != blocks.shape[:1]:
            raise ShapeError(f"a cost of {len(blocks)} candidates is {list(costs.shape)}")
        costs = torch.where(costs.isnan(), math.inf, costs)
        self.evaluations += len(blocks)
        cheapest = int(costs.argmin())
        least = float(costs[cheapest].detach())
        if least < self.least:
            self.least, self.best = least, blocks[cheapest].detach().clone()
        return costs

    def actions(self, blocks: Tensor) -> Actions:
        """Raw actions `[N, T, A]`, inside of their bounds whatever rounding does."""
        raw = self._low + (blocks.clamp(-1, 1) + 1) / 2 * (self._high - self._low)
        raw = torch.minimum(torch.maximum(raw, self._low), self._high)
        return raw.repeat_interleave(self._block, 1)


class SearchPlanner(Planner):
    """Searches blocks of actions; a subclass says how (`search`).

    Its plan is the cheapest candidate that was rolled out.

    Args:
        horizon: blocks planned ahead.
        action_block: actions of a block, which are all the same.
        actions_per_plan: actions taken before it plans again; those of one block by default.
        warm_start: begin from what is left of the plan before, in place of no motion.

    Raises:
        RecipeError: a number below 1, or more actions taken than planned.
    """

    def __init__(
        self,
        *,
        horizon: int = 5,
        action_block: int = 4,
        actions_per_plan: int | None = None,
        warm_start: bool = False,
    ) -> None:
        at_least("horizon", horizon, 1)
        at_least("action_block", action_block, 1)
        taken = action_block if actions_per_plan is None else actions_per_plan
        if not 1 <= taken <= horizon * action_block:
            raise RecipeError(
                f"planner.actions_per_plan={taken}: give 1 to the {horizon * action_block} actions "
                "that are planned (horizon · action_block)"
            )
        self.horizon, self.action_block, self.actions_per_plan = horizon, action_block, taken
        self.warm_start = warm_start
        self._last: Tensor | None = None
        self._rest: Tensor | None = None
        self.usual: Tensor | None = None

    def reset(self) -> None:
        """Forget the last plan."""
        self._last = None

    def search_near(self, rest: Tensor, usual: Tensor | None) -> None:
        """Say where to search, of actions where the bounds are -1 and 1.

        A model knows only actions like those that it was trained on. Far from them a search finds
        what the model is wrong about.

        Args:
            rest: the action `[A]` that asks for no motion now, where a search begins without a last
                plan; the middle of the bounds if this was never called.
            usual: standard deviation `[A]` of the actions that the model was trained on, if known;
                kept as an attribute for those who draw around a mean.
        """
        self._rest = rest.clamp(-1, 1)
        self.usual = None if usual is None else usual.clamp(LEAST, 1)

    def plan(self, cost: RolloutCost, low: Tensor, high: Tensor, rng: torch.Generator) -> Plan:
        """See `Planner.plan`.

        Raises:
            ShapeError: see `Search`.
            RecipeError: no candidate has a cost that is a number.
        """
        search = Search(cost, low, high, self.action_block)
        self.search(search, self._start(len(low)), rng)
        if search.best is None:
            raise RecipeError(
                "no candidate has a finite cost: the model predicts what is not finite, or the "
                "cost cannot be told in any of its futures"
            )
        self._last = search.best
        return Plan(search.actions(search.best[None])[0], search.least, search.evaluations)

    def deviation(self, spread: float | None, without: float, start: Tensor) -> Tensor:
        """Standard deviation `[H, A]` of the first candidates.

        Args:
            spread: the same everywhere; None for that of the actions of the training data,
            without: or this where it is not known.
            start: around which they are drawn, `[H, A]`.
        """
        if spread is None and self.usual is not None:
            return self.usual.expand_as(start).clone()
        return torch.full_like(start, without if spread is None else spread)

    @abstractmethod
    def search(self, search: Search, start: Tensor, rng: torch.Generator) -> None:
        """Ask `search` of candidates `[N, H, A]`, beginning around `start` `[H, A]`."""

    def _start(self, action_size: int) -> Tensor:
        """The plan before without the blocks that were taken, its last one repeated."""
        rest = torch.zeros(action_size) if self._rest is None else self._rest
        start = rest.expand(self.horizon, -1).clone()
        if self.warm_start and self._last is not None:
            start = self.shifted(self._last)
        return start

    def shifted(self, blocks: Tensor) -> Tensor:
        """Blocks `[…, H, A]` as they are by the next decision, the last one repeated."""
        left = blocks[..., self.actions_per_plan // self.action_block :, :]
        end = blocks[..., -1:, :]
        missing = self.horizon - left.shape[-2]
        return torch.cat([left, *[end] * missing], -2)


def at_least(name: str, value: float, least: float) -> None:
    """Refuse a parameter of a planner.

    Raises:
        RecipeError: it lies below `least`.
    """
    if not value >= least:
        raise RecipeError(f"planner.{name}={value}: give {least} or more")
