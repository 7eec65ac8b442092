"""The norm of a gradient, and its clipping, also where each device holds only a part of it."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor


def gradient_norm(parameters: Iterable[nn.Parameter]) -> Tensor:
    """The Euclidean norm of all gradients together, a scalar, the same on every device."""
    norm = nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
    return norm.full_tensor() if isinstance(norm, DTensor) else norm


def clip_norm(parameters: Iterable[nn.Parameter], norm: Tensor, limit: float) -> None:
    """Scale the gradients, whose norm is known, down to norm `limit` if it is larger."""
    gradients = [local(p.grad) for p in parameters if p.grad is not None]
    scale = (limit / (norm + 1e-6)).clamp(max=1.0)  # as torch.nn.utils.clip_grad_norm_ does
    torch._foreach_mul_(gradients, scale)  # pyright: ignore


def clip_values(parameters: Iterable[nn.Parameter], limit: float) -> None:
    """Bring every number of the gradients into [−limit, limit]."""
    for parameter in parameters:
        if parameter.grad is not None:
            local(parameter.grad).clamp_(-limit, limit)


def local(tensor: Tensor) -> Tensor:
    """What this device holds of a tensor: all of it, or its part of a sharded one."""
    return tensor.to_local() if isinstance(tensor, DTensor) else tensor
