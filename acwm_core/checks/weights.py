"""What the checks of models and conditioners do with weights and gradients."""

from __future__ import annotations

from typing import TypeVar

import torch
from torch import Tensor, nn

Module = TypeVar("Module", bound=nn.Module)

SHAKE = 0.05
"""Standard deviation of what is added to every parameter."""


def shaken(module: Module, seed: int = 0) -> Module:
    """The module, with noise added to every parameter in place, so that none is exactly zero."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=SHAKE)
    return module


def without_gradient(module: nn.Module, output: Tensor) -> list[str]:
    """Names of trainable parameters that a random loss on `output` gives no gradient."""
    generator = torch.Generator().manual_seed(0)
    loss = (output * torch.randn(output.shape, generator=generator)).sum()
    named = {name: p for name, p in module.named_parameters() if p.requires_grad}
    gradients = torch.autograd.grad(loss, list(named.values()), allow_unused=True)
    found: list[Tensor | None] = list(gradients)
    return [name for name, g in zip(named, found, strict=True) if g is None or not g.any()]


def batch_error(first: Tensor, second: Tensor) -> float:
    """Largest difference, in units of the larger of 1 and the values' own size."""
    scale = max(1.0, first.abs().max().item())
    return (first - second).abs().max().item() / scale
