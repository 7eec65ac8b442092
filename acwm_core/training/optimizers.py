"""Optimisers, the learning rate, gradient norms, and the moving average of the weights."""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor
from torch.optim import AdamW, Muon, Optimizer

from acwm_core.errors import AcwmWarning
from acwm_core.model.dynamics import hidden_matrices
from acwm_core.model.world_model import WorldModel
from acwm_core.training.config import TrainingConfig
from acwm_core.training.muon import Float32Muon


def build_optimizer(
    module: nn.Module, config: TrainingConfig, *, fused: bool, bfloat16: bool = True
) -> Optimizer:
    """Build AdamW, or Muon for the hidden matrices of `module` and AdamW for all else.

    Args:
        module: the module to train; a `WorldModel` defines itself which are its hidden matrices.
        fused: whether AdamW uses its fused kernel.
        bfloat16: whether Muon computes updates in bfloat16, as PyTorch does, and not in float32.
    """
    settings: dict[str, Any] = {"lr": config.learning_rate, "betas": config.betas, "fused": fused}
    hidden: list[nn.Parameter] = []
    if config.optimizer == "muon":
        is_ours = isinstance(module, WorldModel)
        hidden = module.matrices() if is_ours else hidden_matrices(module)
        if not hidden:
            warnings.warn(
                "the model names no hidden matrices for Muon: AdamW updates all of it",
                AcwmWarning,
                stacklevel=2,
            )
    if not hidden:
        return AdamW(parameter_groups(module, config.weight_decay), **settings)
    others = parameter_groups(module, config.weight_decay, without=hidden)
    muon = (Muon if bfloat16 else Float32Muon)(
        hidden,
        lr=config.learning_rate,
        weight_decay=config.weight_decay,
        adjust_lr_fn="match_rms_adamw",  # so that one learning rate suits both
    )
    return JoinedOptimizer(muon, AdamW(others, **settings))


class JoinedOptimizer(Optimizer):
    """Joins optimisers of different parameters into one, with one list of groups and one state."""

    def __init__(self, *optimizers: Optimizer) -> None:
        self._optimizers = optimizers
        super().__init__(
            [group for optimizer in optimizers for group in optimizer.param_groups], {}
        )
        self._share()

    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # pyright: ignore
        """One step of every optimiser, after one evaluation of `closure`."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for optimizer in self._optimizers:
            optimizer.step()
        return loss

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load a state that `state_dict` returned."""
        super().load_state_dict(state_dict)
        self._share()

    def _share(self) -> None:
        """Make all optimisers use the groups and state of this one."""
        start = 0
        for optimizer in self._optimizers:
            stop = start + len(optimizer.param_groups)
            optimizer.param_groups = self.param_groups[start:stop]
            optimizer.state = self.state
            start = stop


def parameter_groups(
    module: nn.Module, weight_decay: float, without: Iterable[nn.Parameter] = ()
) -> list[dict[str, Any]]:
    """AdamW's parameter groups: weight decay on matrices and kernels, not on vectors or embeddings.

    Norm gains and biases are vectors. Embeddings are lookup tables: decay would pull all their rows
    to zero, also those that are rarely used.
    """
    left_out = {id(parameter) for parameter in without}
    embeddings = [child for child in module.modules() if isinstance(child, nn.Embedding)]
    tables = {id(parameter) for embedding in embeddings for parameter in embedding.parameters()}
    decayed: list[nn.Parameter] = []
    free: list[nn.Parameter] = []
    for parameter in module.parameters():
        if parameter.requires_grad and id(parameter) not in left_out:
            plain = parameter.ndim < 2 or id(parameter) in tables
            (free if plain else decayed).append(parameter)
    groups = [{"params": decayed, "weight_decay": weight_decay}]
    return [*groups, {"params": free, "weight_decay": 0.0}]


def learning_rate_factor(step: int, config: TrainingConfig, max_steps: int) -> float:
    """The factor on the peak learning rate in optimiser step `step` (from 0).

    It rises linearly over `warmup_steps` (and is above 0 in the first step), stays at 1, and falls
    from `decay_start · max_steps` to 0 at `max_steps`, linearly or as half a cosine.

    Args:
        max_steps: length of training; used only by schedules that decay.
    """
    warmup = min(1.0, (step + 1) / config.warmup_steps) if config.warmup_steps else 1.0
    if config.schedule == "constant":
        return warmup
    start = config.decay_start * max_steps
    progress = min(1.0, max(0.0, (step - start) / (max_steps - start)))
    if config.schedule == "linear":
        return warmup * (1 - progress)
    return warmup * 0.5 * (1 + math.cos(math.pi * progress))


def gradient_norm(parameters: Iterable[nn.Parameter]) -> Tensor:
    """The Euclidean norm of all gradients together: a scalar, the same on every device."""
    return total_norm(p.grad for p in parameters if p.grad is not None)


def total_norm(tensors: Iterable[Tensor]) -> Tensor:
    """The Euclidean norm of all tensors together: a scalar, the same on every device."""
    norm = nn.utils.get_total_norm([*tensors])
    return norm.full_tensor() if isinstance(norm, DTensor) else norm


def local(tensor: Tensor) -> Tensor:
    """The part of a tensor on this device: all of it, or the local shard of a sharded one."""
    return tensor.to_local() if isinstance(tensor, DTensor) else tensor


def averaged_copy(world_model: WorldModel) -> WorldModel:
    """A frozen copy in evaluation mode, for the weight average; it shares the frozen codec."""
    codec = world_model.codec
    return copy.deepcopy(world_model, {id(codec): codec}).requires_grad_(False).eval()


def decay_at(step: int, decay: float) -> float:
    """The decay in update `step` (from 1), with a ramp so that the initial weights are forgotten.

    After n updates it is min(decay, (1 + n) / (10 + n)), the ramp of TensorFlow's
    ``ExponentialMovingAverage`` and diffusers' ``EMAModel``.
    """
    return min(decay, (1 + step) / (10 + step))


@torch.no_grad()
def update_average(averaged: WorldModel, world_model: WorldModel, decay: float) -> None:
    """average ← decay · average + (1 − decay) · weights, in place; buffers are copied.

    Lightning's `WeightAveraging` copies the module with its codec, which sharded weights refuse.
    """
    for name in ("model", "conditioner"):
        mean: nn.Module = getattr(averaged, name)
        current: nn.Module = getattr(world_model, name)
        means = [local(parameter) for parameter in mean.parameters()]
        weights = [local(parameter) for parameter in current.parameters()]
        torch._foreach_lerp_(means, weights, 1 - decay)  # pyright: ignore
        for kept, buffer in zip(mean.buffers(), current.buffers(), strict=True):
            kept.copy_(buffer)
