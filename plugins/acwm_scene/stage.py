"""A stage of training before the first step on pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from acwm_core.errors import TrainingError
from acwm_core.executors import progress_bar


@dataclass(frozen=True)
class Stage:
    """How a part of a scene is trained for some steps, before the first one on pictures.

    Attributes:
        name: what is learnt, for the progress bar and errors.
        setting: where a recipe sets the number of steps.
        warmup: steps until the learning rate has its peak.
        decay: how steeply the rate falls at the end: linearly to 0, over the last `1 / decay` of
            the steps.
        clipped: largest norm of the gradient.
    """

    name: str
    setting: str
    warmup: int
    decay: float
    clipped: float

    def train(
        self,
        loss_of: Callable[[int], Tensor],
        optimizers: Sequence[tuple[Optimizer, float]],
        steps: int,
        *,
        shown: bool,
    ) -> None:
        """Take some steps.

        Args:
            loss_of: the loss of a step, by its number from 0.
            optimizers: each with its peak learning rate.
            steps: how many.
            shown: whether a progress bar is shown.

        Raises:
            TrainingError: the gradient stopped being finite.
        """
        groups = [
            (group, rate) for optimizer, rate in optimizers for group in optimizer.param_groups
        ]
        weights = [parameter for group, _ in groups for parameter in group["params"]]
        loss = torch.zeros(())
        bar = progress_bar(
            *(self.name, steps), unit="steps", shown=shown, note=lambda: f"loss {loss:.4f}"
        )
        with bar as report:
            for step in range(steps):
                share = min(1, (step + 1) / self.warmup, self.decay * (1 - step / steps))
                for group, rate in groups:
                    group["lr"] = rate * share
                for optimizer, _ in optimizers:
                    optimizer.zero_grad()
                loss = loss_of(step)
                cast(Any, loss).backward()
                if not nn.utils.clip_grad_norm_(weights, self.clipped).isfinite():
                    raise TrainingError(
                        f"{self.name}: the loss is not finite in step {step + 1} of "
                        f"{self.setting}: look at the data, and at data.states"
                    )
                for optimizer, _ in optimizers:
                    optimizer.step()
                report(1)
        for parameter in weights:
            parameter.grad = None
