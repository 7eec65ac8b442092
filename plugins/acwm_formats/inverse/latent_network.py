"""The networks that learn latent actions: what two frames need to be distinguished, and no more.

One reads a few whole numbers from the frames around a moment; another predicts the next frame from
the last two and these numbers (Schmidt and Jiang 2024, arXiv 2312.10812). The numbers are levels of
bounded values (Mentzer et al. 2023, arXiv 2309.15505), so there is no table of codes to collapse,
and each is a control of its own: zero is the middle, and neighbours are alike.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from acwm_formats.inverse.network import CHANGE, InverseDynamics

HIGHEST = 2
"""Levels are whole numbers from −2 to 2."""

WIDTHS = (6, 24, 48, 96)
"""Channels of the two frames before a moment, and of them at a half, a quarter and an eighth."""

HERE = 1
"""Place of the frame in which an action begins, among those of a window."""


class LatentDynamics(nn.Module):
    """Reads latent actions, and predicts the next frame by them.

    Args:
        dimensions: number D of whole numbers in an action.
    """

    def __init__(self, dimensions: int) -> None:
        super().__init__()
        self.inverse = InverseDynamics(dimensions)
        self.spread = nn.BatchNorm1d(dimensions, affine=False)  # otherwise all end at one level
        self.embed = nn.Sequential(nn.Linear(dimensions, 128), nn.SiLU())
        self.down, self.up, self.shift = nn.ModuleList(), nn.ModuleList(), nn.ModuleList()
        for inner, outer in itertools.pairwise(WIDTHS):
            layers = nn.Conv2d(inner, outer, 3, 2, 1), nn.GroupNorm(8, outer), nn.SiLU()
            self.down.append(nn.Sequential(*layers))
            self.up.append(nn.Conv2d(outer + inner, max(inner, 16), 3, 1, 1))
            self.shift.append(nn.Linear(128, 2 * outer))
        self.draw = nn.Conv2d(16, 3, 3, 1, 1)

    def latents(self, frames: Tensor) -> Tensor:
        """The latent actions of windows of frames, `[B, D]` whole numbers; with a gradient.

        Args:
            frames: `[B, len(CONTEXT), 3, h, w]` uint8.
        """
        bounded = HIGHEST * torch.tanh(self.spread(self.inverse(frames)[0]))
        return bounded + (bounded.round() - bounded).detach()

    def forward(self, frames: Tensor, latents: Tensor) -> Tensor:
        """The change to the next frame by these latent actions, `[B, 3, h, w]`; see `change`."""
        pixels = frames[:, : HERE + 1].float() / 127.5 - 1
        seen = torch.cat([pixels[:, HERE], CHANGE * (pixels[:, HERE] - pixels[:, HERE - 1])], 1)
        embedded, skips = self.embed(latents), list[Tensor]()
        for layer in self.down:
            skips.append(seen)
            seen = layer(seen)
        parts = [*zip(skips, self.up, self.shift, strict=True)]
        for skip, layer, shift in reversed(parts):
            scale, offset = shift(embedded)[..., None, None].chunk(2, 1)
            wide = nn.functional.interpolate(seen * (1 + scale) + offset, size=skip.shape[2:])
            seen = nn.functional.silu(layer(torch.cat([wide, skip], 1)))
        return self.draw(seen)


def change(frames: Tensor) -> Tensor:
    """The true change to the next frame, enlarged by `CHANGE`, `[B, 3, h, w]`."""
    return CHANGE * (frames[:, HERE + 1].float() - frames[:, HERE].float()) / 127.5
