"""Muon where bfloat16 is slow; PyTorch's makes updates orthogonal in bfloat16 everywhere."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.optim import Muon

RMS = 0.2
"""Root mean square of updates with ``adjust_lr_fn="match_rms_adamw"``, by which learning rates of
AdamW suit (arXiv 2502.16982)."""


class Float32Muon(Muon):
    """`torch.optim.Muon`, all of it in float32.

    Without instructions for bfloat16, a CPU converts every value: on AVX2 the update of a matrix of
    96 × 864 takes 48 ms, and 5 ms in float32. State and groups are those of PyTorch's, so either
    goes on where the other ended.
    """

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # pyright: ignore
        """One step, after an evaluation of `closure`, if any."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for weights in group["params"]:
                if weights.grad is not None:
                    self._update(weights, weights.grad, group)
        return loss

    def _update(self, weights: Tensor, gradient: Tensor, group: dict[str, Any]) -> None:
        state = self.state[weights]
        if not state:
            state["momentum_buffer"] = torch.zeros_like(gradient)
        mean, momentum = state["momentum_buffer"], group["momentum"]
        mean.lerp_(gradient, 1 - momentum)
        update = gradient.lerp(mean, momentum) if group["nesterov"] else mean
        update = orthogonal(update, group["ns_coefficients"], group["ns_steps"], group["eps"])
        weights.mul_(1 - group["lr"] * group["weight_decay"])
        rows, columns = weights.shape
        matches_adamw = group["adjust_lr_fn"] == "match_rms_adamw"
        scale = RMS**2 * max(rows, columns) if matches_adamw else max(1, rows / columns)
        weights.add_(update, alpha=-group["lr"] * math.sqrt(scale))


def orthogonal(
    matrix: Tensor, coefficients: tuple[float, float, float], steps: int, eps: float
) -> Tensor:
    """A matrix `[m, n]` with its singular values near one, by Newton-Schulz iterations.

    See Jordan et al. 2024, https://kellerjordan.github.io/posts/muon.
    """
    a, b, c = coefficients
    is_tall = matrix.shape[0] > matrix.shape[1]
    result = matrix.t() if is_tall else matrix
    result = result / result.square().sum().sqrt().clamp(min=eps)
    for _ in range(steps):
        gram = result @ result.t()
        change = torch.addmm(gram, gram, gram, beta=b, alpha=c)
        result = torch.addmm(result, change, result, beta=a)
    return result.t() if is_tall else result
