"""The optimisers that a recipe can name: AdamW, and Muon for the hidden matrices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import nn
from torch.optim import AdamW, Muon, Optimizer

from acwm_core.dynamics import hidden_matrices
from acwm_core.errors import RecipeError
from acwm_core.training.config import TrainingConfig
from acwm_core.world_model import WorldModel


def build_optimizer(module: WorldModel, config: TrainingConfig, *, fused: bool) -> Optimizer:
    """The optimiser of the trainable parameters of `module`.

    Args:
        module: what is trained.
        config: the recipe's section `training`.
        fused: update all of AdamW's parameters in one kernel.

    Raises:
        RecipeError: Muon is asked for, and the model has no matrices for it.
    """
    settings: dict[str, Any] = {"lr": config.learning_rate, "betas": config.betas, "fused": fused}
    if config.optimizer == "adamw":
        return AdamW(parameter_groups(module, config.weight_decay), **settings)
    hidden = [*module.model.matrices(), *hidden_matrices(module.conditioner)]
    others = parameter_groups(module, config.weight_decay, without=hidden)
    if not hidden:
        raise RecipeError(
            f"training.optimizer=muon needs hidden matrices, and {type(module.model).__name__} "
            "has none: set training.optimizer=adamw"
        )
    muon = Muon(
        hidden,
        lr=config.learning_rate,
        weight_decay=config.weight_decay,
        adjust_lr_fn="match_rms_adamw",  # so that AdamW's learning rates serve both
    )
    return JoinedOptimizer(muon, AdamW(others, **settings))


class JoinedOptimizer(Optimizer):
    """Optimisers of different parameters as one, with one list of groups and one state.

    Args:
        *parts: the optimisers.
    """

    def __init__(self, *parts: Optimizer) -> None:
        self._parts = parts
        super().__init__([group for part in parts for group in part.param_groups], {})
        self._share()

    def step(self, closure: Callable[[], Any] | None = None) -> Any:  # pyright: ignore
        """One step of every part, after one evaluation of `closure`."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for part in self._parts:
            part.step()
        return loss

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load what `state_dict` gave."""
        super().load_state_dict(state_dict)
        self._share()

    def _share(self) -> None:
        """Let the parts work on this optimiser's own groups and state."""
        start = 0
        for part in self._parts:
            stop = start + len(part.param_groups)
            part.param_groups = self.param_groups[start:stop]
            part.state = self.state
            start = stop


def parameter_groups(
    module: nn.Module, weight_decay: float, without: list[nn.Parameter] | None = None
) -> list[dict[str, Any]]:
    """AdamW's groups: weight decay on matrices and kernels, none on vectors and embeddings.

    Norm gains and biases are vectors; lookup tables are matrices that decay would pull to zero row
    by row, the rare ones too.

    Args:
        module: what is trained.
        weight_decay: of the first group.
        without: parameters to leave out.
    """
    left_out = {id(parameter) for parameter in without or []}
    tables = {
        id(parameter)
        for part in module.modules()
        if isinstance(part, nn.Embedding)
        for parameter in part.parameters()
    }
    decayed: list[nn.Parameter] = []
    free: list[nn.Parameter] = []
    for parameter in module.parameters():
        if parameter.requires_grad and id(parameter) not in left_out:
            plain = parameter.ndim < 2 or id(parameter) in tables
            (free if plain else decayed).append(parameter)
    groups = [{"params": decayed, "weight_decay": weight_decay}]
    return [*groups, {"params": free, "weight_decay": 0.0}]
