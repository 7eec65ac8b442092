"""The network: from a few frames around a moment to the action taken in it, and how sure it is."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

CONTEXT = (-1, 0, 1, 2)
"""The frames that it sees, counted from the one in which the action begins."""

WIDTHS = (32, 64, 96, 128)
GRID, HIDDEN = 4, 256

CHANGE = 4.0
"""By how much changes between frames are enlarged, which are small beside what stands still."""


class InverseDynamics(nn.Module):
    """Reads an action from frames before and after it.

    Args:
        actions: number A of dimensions.
    """

    def __init__(self, actions: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inner, outer in itertools.pairwise((3 * len(CONTEXT), *WIDTHS)):
            layers += [nn.Conv2d(inner, outer, 3, 2, 1), nn.GroupNorm(8, outer), nn.SiLU()]
        self.see = nn.Sequential(*layers)
        self.read = nn.Sequential(
            nn.Linear(GRID * GRID * WIDTHS[-1], HIDDEN), nn.SiLU(), nn.Linear(HIDDEN, 2 * actions)
        )

    def forward(self, frames: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and logarithm of the variance of the actions, `[B, A]` each, in standard units.

        Args:
            frames: `[B, len(CONTEXT), 3, h, w]` uint8.
        """
        pixels = frames.float() / 127.5 - 1
        changes = CHANGE * (pixels[:, 1:] - pixels[:, :-1])
        inputs = torch.cat([pixels[:, :1], changes], 1).flatten(1, 2)
        seen = nn.functional.adaptive_avg_pool2d(self.see(inputs), GRID)
        mean, log_variance = self.read(seen.flatten(1)).chunk(2, 1)
        return mean, log_variance.clamp(-8, 4)


def loss_of(mean: Tensor, log_variance: Tensor, actions: Tensor) -> Tensor:
    """Negative log-likelihood, weighted by the deviation so that uncertain actions count too.

    Without the weight, what is read badly at first is explained away (Seitzer et al. 2022, arXiv
    2203.09168, β = 0.5).
    """
    error = (actions - mean) ** 2 / log_variance.exp() + log_variance
    return (error * (log_variance.detach() / 2).exp()).mean()


def window(frames: Tensor, moment: int) -> Tensor:
    """The frames that are seen at a moment of an episode `[T, 3, h, w]`; its ends are repeated."""
    places = [min(max(moment + offset, 0), len(frames) - 1) for offset in CONTEXT]
    return frames[torch.tensor(places)]
