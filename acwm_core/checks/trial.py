"""Test material for the checks: episodes, a synthetic clip, perturbed weights."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn

from acwm_core.checks.result import Suite
from acwm_core.data.simulate import simulate
from acwm_core.env.environment import Environment, EnvironmentCard
from acwm_core.env.episode import Episode, EpisodeSpec, Split
from acwm_core.model.shapes import Video

Module = TypeVar("Module", bound=nn.Module)

SMALL = 64
"""Frame height at which episodes are simulated, if the aspect ratio allows it."""

BEGINNING = 32
"""Number of frames of episodes that are simulated repeatedly, if the horizon is longer."""


class EnvironmentTrial(Suite):
    """An environment, which must accept `size`, and its episodes, simulated on first use."""

    kind = "environment"

    @functools.cached_property
    def size(self) -> tuple[int, int]:
        """The smallest frame size with the card's aspect ratio and a height of at least `SMALL`."""
        height, width = self.make().card.frame_size
        fit = (small for small in range(SMALL, height, 8) if small * width % (8 * height) == 0)
        small = next(fit, height)
        return small, small * width // height

    @functools.cached_property
    def environment(self) -> Environment:
        """The environment at the small size."""
        return self.make(size=self.size)

    @property
    def card(self) -> EnvironmentCard:
        """The environment's card."""
        return self.environment.card

    @functools.cached_property
    def episode(self) -> Episode:
        """Training episode 0, run with the environment's policy."""
        return simulate(self.environment, self.spec())

    @functools.cached_property
    def beginning(self) -> Episode:
        """The first `BEGINNING` frames of `episode`, simulated on their own."""
        return simulate(self.environment, self.spec(), frames=BEGINNING)

    def spec(self, split: Split = "train", index: int = 0) -> EpisodeSpec:
        """The spec of an episode of this environment."""
        return EpisodeSpec(self.card.name, split, index)


def moving_discs(batch: int, frames: int, height: int, width: int, seed: int = 0) -> Video:
    """Coloured discs that move over a shaded background, different ones in each clip of a batch."""
    generator = torch.Generator().manual_seed(seed)
    y = torch.linspace(0, 1, height)[:, None]
    x = torch.linspace(0, 1, width)
    shade = (0.35 + 0.4 * y + 0.15 * x).expand(batch, frames, 3, height, width)
    video = shade * torch.tensor([1.0, 0.95, 0.85])[:, None, None]
    time = torch.arange(frames)[:, None, None, None] / 16
    for _ in range(3):
        start_x, start_y, turn, *colour = torch.rand(6, batch, 1, 1, 1, 1, generator=generator)
        centre_x = 0.5 + 0.35 * torch.sin(2 * math.pi * (start_x + time * (0.3 + turn)))
        centre_y = 0.5 + 0.35 * torch.cos(2 * math.pi * (start_y + time * (0.3 + turn)))
        distance = torch.hypot(x - centre_x, y - centre_y)
        covered = ((0.12 - distance) * max(height, width) + 0.5).clamp(0, 1)
        video = video + covered * (torch.cat(colour, dim=2) - video)
    return video


def shaken(module: Module) -> Module:
    """Add noise to every parameter in place, so that none is exactly zero; returns the module."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=0.05)
    return module


def noise(shape: Sequence[int], seed: int) -> Tensor:
    """Normally distributed numbers that depend only on shape and seed."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def without_gradient(module: nn.Module, output: Tensor) -> list[str]:
    """Names of trainable parameters that get no gradient from a random loss on `output`."""
    loss = (output * noise(output.shape, seed=0)).sum()
    named = {name: p for name, p in module.named_parameters() if p.requires_grad}
    gradients = torch.autograd.grad(loss, list(named.values()), materialize_grads=True)
    return [name for name, gradient in zip(named, gradients, strict=True) if not gradient.any()]


def batch_error(first: Tensor, second: Tensor) -> float:
    """Largest absolute difference, relative to the largest value in `first` (at least 1)."""
    scale = max(1.0, first.abs().max().item())
    return (first - second).abs().max().item() / scale
