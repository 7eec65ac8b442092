"""Shared by all planners here: blocks of actions, bounds, counting, and the best candidate."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Literal

import torch
from torch import Tensor

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.shapes import Actions
from acwm_planning.planner import Plan, Planner, RolloutCost

MIN_ACTION_STD = 0.02
"""Smallest value of `SearchPlanner.action_std`, for actions scaled to [-1, 1]."""


class Search:
    """A cost of blocks `[N, H, A]` in [-1, 1] that remembers the best and counts evaluations.

    Args:
        cost: maps raw actions `[N, T, A]` to costs `[N]`.
        low, high: bounds `[A]` of raw actions; they correspond to -1 and 1.
        action_block: number of actions of each block.
        previous: the action `[A]` in [-1, 1] from which the first block leads to its own, and each
            later one from that of its predecessor, in equal steps. None if blocks repeat theirs.

    Attributes:
        best: the cheapest blocks so far, `[H, A]`; None as long as no candidate has a finite cost.
        best_cost: the cost of `best`.
        evaluations: number of candidates evaluated so far.
    """

    def __init__(
        self,
        cost: RolloutCost,
        low: Tensor,
        high: Tensor,
        action_block: int,
        previous: Tensor | None = None,
    ) -> None:
        self._cost, self._low, self._high, self._block = cost, low, high, action_block
        self._previous = previous
        self.best: Tensor | None = None
        self.best_cost, self.evaluations = math.inf, 0

    def __call__(self, blocks: Tensor) -> Tensor:
        """Evaluate blocks; returns costs `[N]`. NaN becomes infinite, so that it is never the best.

        Raises:
            ShapeError: the cost does not return one number per candidate.
        """
        costs = self._cost(self.actions(blocks))
        if costs.shape != blocks.shape[:1]:
            raise ShapeError(f"a cost of {len(blocks)} candidates is {list(costs.shape)}")
        costs = torch.where(costs.isnan(), math.inf, costs)
        self.evaluations += len(blocks)
        cheapest = int(costs.argmin())
        cost = float(costs[cheapest].detach())
        if cost < self.best_cost:
            self.best_cost, self.best = cost, blocks[cheapest].detach().clone()
        return costs

    def actions(self, blocks: Tensor) -> Actions:
        """Raw actions `[N, T, A]`, clipped so that rounding cannot push them out of bounds."""
        scaled = blocks.clamp(-1, 1).repeat_interleave(self._block, 1)
        if self._previous is not None:
            first = self._previous.to(blocks).expand(len(blocks), self._block, -1)
            earlier = torch.cat([first, scaled[:, : -self._block]], 1)
            share = (torch.arange(scaled.shape[1]) % self._block + 1) / self._block
            scaled = earlier + share[:, None] * (scaled - earlier)
        raw = self._low + (scaled + 1) / 2 * (self._high - self._low)
        return torch.minimum(torch.maximum(raw, self._low), self._high)


class SearchPlanner(Planner):
    """Searches over blocks of actions; a subclass implements `search`.

    Its plan is the cheapest candidate that was rolled out.

    Args:
        horizon: number of blocks to plan ahead.
        action_block: number of video frames of a block.
        interpolation: ``hold``: a block holds its action; ``linear``: it leads there in equal
            steps, from the action of the block before or, at first, from the one that means no
            motion now. If actions are positions, the latter searches paths of moderate speed.
        actions_per_plan: number of actions to take before planning again; one block by default.
        warm_start: start from the rest of the previous plan, instead of no motion.
        prior: folder of a trained policy; the search starts from what it would do in the model,
            which is a candidate too.

    Raises:
        RecipeError: a number is below 1, or more actions are taken than planned.
    """

    def __init__(
        self,
        *,
        horizon: int = 5,
        action_block: int = 4,
        interpolation: Literal["hold", "linear"] = "hold",
        actions_per_plan: int | None = None,
        warm_start: bool = False,
        prior: str | None = None,
    ) -> None:
        at_least("horizon", horizon, 1)
        at_least("action_block", action_block, 1)
        count = action_block if actions_per_plan is None else actions_per_plan
        if not 1 <= count <= horizon * action_block:
            raise RecipeError(
                f"planner.actions_per_plan={count}: give 1 to the {horizon * action_block} actions "
                "that are planned (horizon · action_block)"
            )
        self.horizon, self.action_block, self.actions_per_plan = horizon, action_block, count
        self.interpolation, self.warm_start, self.prior = interpolation, warm_start, prior
        self._last: Tensor | None = None
        self._proposal: Tensor | None = None
        self._still: Tensor | None = None
        self.action_std: Tensor | None = None

    def reset(self) -> None:
        """Forget the last plan."""
        self._last = None

    def search_near(self, still: Tensor, action_std: Tensor | None) -> None:
        """Set the region to search, in actions scaled to [-1, 1].

        A model only knows actions like those that it was trained on. Far from these, a search
        exploits the model's errors.

        Args:
            still: the action `[A]` that means no motion now. A search without a previous plan
                starts there, or at the middle of the bounds if this method was never called.
            action_std: standard deviation `[A]` of the actions that the model was trained on, if
                known; stored as an attribute for planners that draw around a mean.
        """
        self._still = still.clamp(-1, 1)
        self.action_std = None if action_std is None else action_std.clamp(MIN_ACTION_STD, 1)

    def propose(self, actions: Tensor) -> None:
        """Start the next search from actions `[horizon · action_block, A]`, scaled to [-1, 1]."""
        blocks = actions.unflatten(0, (self.horizon, self.action_block))
        self._proposal = blocks.mean(1) if self.interpolation == "hold" else blocks[:, -1]

    def plan(self, cost: RolloutCost, low: Tensor, high: Tensor, rng: torch.Generator) -> Plan:
        """See `Planner.plan`.

        Raises:
            RecipeError: no candidate has a finite cost.
        """
        previous = self._still_action(len(low)) if self.interpolation == "linear" else None
        search = Search(cost, low, high, self.action_block, previous)
        if self._proposal is not None:
            search(self._proposal[None])
        self.search(search, self._start(len(low)), rng)
        self._proposal = None
        if search.best is None:
            raise RecipeError(
                "no candidate has a finite cost: the model's predictions are not finite, or the "
                "cost cannot be computed for any of them"
            )
        self._last = search.best
        return Plan(search.actions(search.best[None])[0], search.best_cost, search.evaluations)

    def initial_std(self, spread: float | None, default: float, start: Tensor) -> Tensor:
        """Standard deviation `[H, A]` of the first candidates.

        Args:
            spread: the value for all blocks; None for that of the training actions.
            default: the value to use with None if that of the training actions is not known.
            start: blocks around which candidates are drawn, `[H, A]`.
        """
        if spread is None and self.action_std is not None:
            return self.action_std.expand_as(start).clone()
        return torch.full_like(start, default if spread is None else spread)

    @abstractmethod
    def search(self, search: Search, start: Tensor, rng: torch.Generator) -> None:
        """Evaluate candidates `[N, H, A]` with `search`, starting around `start` `[H, A]`."""

    def _start(self, action_size: int) -> Tensor:
        """Where to start: the proposal, the rest of the previous plan, or no motion."""
        if self._proposal is not None:
            return self._proposal.clone()
        start = self._still_action(action_size).expand(self.horizon, -1).clone()
        if self.warm_start and self._last is not None:
            start = self.shifted(self._last)
        return start

    def _still_action(self, action_size: int) -> Tensor:
        """The action `[A]` that means no motion now, in [-1, 1]."""
        return torch.zeros(action_size) if self._still is None else self._still

    def shifted(self, blocks: Tensor) -> Tensor:
        """Blocks `[…, H, A]` without those already taken; the last one is repeated at the end."""
        remaining = blocks[..., self.actions_per_plan // self.action_block :, :]
        end = blocks[..., -1:, :]
        missing = self.horizon - remaining.shape[-2]
        return torch.cat([remaining, *[end] * missing], -2)


def at_least(name: str, value: float, minimum: float) -> None:
    """Check the lower limit of a planner's parameter.

    Raises:
        RecipeError: the value is below `minimum`.
    """
    if not value >= minimum:
        raise RecipeError(f"planner.{name}={value}: give {minimum} or more")
