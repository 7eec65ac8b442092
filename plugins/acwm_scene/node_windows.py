"""Windows of the training clips in which nodes move: short ones first."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from acwm_scene.nodes import Form

HORIZONS = ((0.3, 4), (0.6, 8), (1.0, 16))
"""Until which share of the training windows have so many frames."""

NODES = 12_000
"""Nodes in all frames of all windows of a step together."""

STILL = 0.1
"""Share of the windows in which nothing moves that are kept."""

MOVES = 0.05
"""How far a node has to move in a window to count as moving, in units."""


def node_windows(true: Form, random: torch.Generator, progress: float, ends: bool) -> Form:
    """Windows `[B, 2 + H, …]` of clips, from the frame before the first one on.

    Most are windows in which a node moves. Each is seen from another side: turned about the
    vertical through the origin, mirrored or not, and, with `ends`, counted from either end. For
    what moves nodes is the same in all horizontal directions.

    Args:
        true: forms in all video frames of the clips.
        random: the only source of randomness.
        progress: share of the training that is over, 0 to 1.
        ends: whether the nodes may be counted from either end.
    """
    clips, frames = true.nodes.shape[:2]
    horizon = min(frames - 1, next(size for until, size in HORIZONS if progress <= until))
    wanted = max(16, NODES // (true.nodes.shape[2] * horizon))
    rows = torch.randint(clips, (4 * wanted,), generator=random)
    starts = torch.randint(frames - horizon, (4 * wanted,), generator=random)
    kept = torch.rand(4 * wanted, generator=random) < STILL
    device = true.nodes.device
    first, last = (true.nodes[rows.to(device), (starts + far).to(device)] for far in (0, horizon))
    kept |= ((last - first).abs().amax((1, 2)) > MOVES).cpu()
    chosen = kept.nonzero()[:wanted, 0]
    if not len(chosen):
        chosen = torch.arange(wanted)
    numbers = (starts[chosen, None] + torch.arange(-1, horizon + 1)).clamp(min=0).to(device)
    window = Form(*(values[rows[chosen, None].to(device), numbers] for values in true))
    count = len(chosen)
    angle = 2 * math.pi * torch.rand(count, generator=random)
    side = torch.randint(2, (count,), generator=random) * 2 - 1
    turned = Form(*(_seen_from(values, angle.to(device), side.to(device)) for values in window))
    return (
        turned.reversed((torch.rand(count, generator=random) < 0.5).to(device)) if ends else turned
    )


def _seen_from(places: Tensor, angle: Tensor, side: Tensor) -> Tensor:
    """Places `[B, T, N, D]` mirrored, where `side` is −1, and turned by `angle` rad."""
    c, s = (part[:, None, None] for part in (angle.cos(), angle.sin()))
    x, y = places[..., 0] * side[:, None, None], places[..., 1]
    return torch.cat([torch.stack([c * x - s * y, s * x + c * y], -1), places[..., 2:]], -1)
