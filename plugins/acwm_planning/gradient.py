"""A planner that follows the gradient of the cost through the model."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from acwm_core.errors import RecipeError
from acwm_planning.search import Search, SearchPlanner, at_least


class Gradient(SearchPlanner):
    """Optimises the actions with Adam, from several starts at once, within their bounds.

    It needs a model and a cost with gradients, and finds the local minimum near each start.

    Args:
        candidates: number of starts: one at the beginning of the search, the others around it.
        iterations: number of Adam steps.
        learning_rate: learning rate of Adam, for actions scaled to [-1, 1].
        spread: standard deviation of the starts, for actions scaled to [-1, 1].
        **blocks: see `SearchPlanner`.

    Raises:
        RecipeError: a number is too small.
    """

    def __init__(
        self,
        *,
        candidates: int = 16,
        iterations: int = 20,
        learning_rate: float = 0.1,
        spread: float = 0.5,
        warm_start: bool = True,
        **blocks: Any,
    ) -> None:
        super().__init__(warm_start=warm_start, **blocks)
        at_least("candidates", candidates, 1)
        at_least("iterations", iterations, 1)
        at_least("learning_rate", learning_rate, 1e-9)
        at_least("spread", spread, 0)
        self.candidates, self.iterations = candidates, iterations
        self.learning_rate, self.spread = learning_rate, spread

    def search(self, search: Search, start: Tensor, rng: torch.Generator) -> None:
        """Descend from all starts at once. Costs are summed, so each start has its own gradient.

        Raises:
            RecipeError: the cost has no gradient.
        """
        noise = torch.randn(self.candidates - 1, *start.shape, generator=rng)
        starts = torch.cat([start[None], start + self.spread * noise]).clamp(-1, 1)
        blocks = starts.requires_grad_()
        adam = torch.optim.Adam([blocks], lr=self.learning_rate)
        for _ in range(self.iterations):
            with torch.enable_grad():
                costs = search(blocks)
                if not costs.requires_grad:
                    raise RecipeError(
                        "planner=gradient needs a cost that is differentiable through this model, "
                        "but this one is not: use cost=latent, or planner=icem"
                    )
                adam.zero_grad()
                torch.where(costs.isfinite(), costs, 0.0).sum().backward()
            assert blocks.grad is not None
            blocks.grad.nan_to_num_(0.0, 0.0, 0.0)
            adam.step()
            with torch.no_grad():
                blocks.clamp_(-1, 1)
        with torch.no_grad():
            search(blocks)
