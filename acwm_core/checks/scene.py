"""A synthetic clip to try codecs and metrics on: coloured discs that cross a shaded background."""

from __future__ import annotations

import math

import torch

from acwm_core.shapes import Video

DISCS = 3


def moving_discs(batch: int, frames: int, height: int, width: int, seed: int = 0) -> Video:
    """Video `[B, T, 3, H, W]` in [0, 1], different in every batch element and frame."""
    generator = torch.Generator().manual_seed(seed)
    y = torch.linspace(0, 1, height)[:, None]
    x = torch.linspace(0, 1, width)
    shade = (0.35 + 0.4 * y + 0.15 * x).expand(batch, frames, 3, height, width)
    video = shade * torch.tensor([1.0, 0.95, 0.85])[:, None, None]
    time = torch.arange(frames)[:, None, None, None] / 16
    for _ in range(DISCS):
        start_x, start_y, turn, *colour = torch.rand(6, batch, 1, 1, 1, 1, generator=generator)
        centre_x = 0.5 + 0.35 * torch.sin(2 * math.pi * (start_x + time * (0.3 + turn)))
        centre_y = 0.5 + 0.35 * torch.cos(2 * math.pi * (start_y + time * (0.3 + turn)))
        distance = torch.hypot(x - centre_x, y - centre_y)
        covered = ((0.12 - distance) * max(height, width) + 0.5).clamp(0, 1)
        video = video + covered * (torch.cat(colour, dim=2) - video)
    return video
