"""Windows of the training clips in which bodies move: short ones first."""

from __future__ import annotations

import torch
from torch import Tensor

from acwm_core.env.rotations import angle_of_code
from acwm_scene.poses import Poses, turned_back

HORIZONS = ((0.35, 4), (0.65, 8), (1.0, 16))
"""Until which share of the training windows have so many frames. Longer ones taught it worse: after
a missed push, what follows is chance."""

FRAMES = 1536
"""Frames of all windows of a step together."""

FEWEST = 24
"""Windows of a step, at least."""

STILL = 0.1
"""Share of the windows in which nothing moves that are kept."""

MOVES = 0.02
"""How far a body has to move in a frame to count as moving, in units."""


def moving_windows(
    true: Poses, random: torch.Generator, progress: float, folds: int
) -> tuple[Poses, tuple[Tensor, Tensor]]:
    """Windows `[B, 1 + H, …]` of clips, and how places and angles changed just before each.

    Most are windows in which a body moves. Bodies that no window has are left out.

    Args:
        true: poses in all video frames of the clips.
        random: the only source of randomness.
        progress: share of the training that is over, 0 to 1.
        folds: in how many ways a body can be turned and look the same.
    """
    frames = true.places.shape[1]
    horizon = min(frames - 1, next(size for until, size in HORIZONS if progress <= until))
    wanted = max(FEWEST, FRAMES // horizon)
    rows, starts = _chosen(true, horizon, wanted, random)
    numbers = starts[:, None] + torch.arange(-1, horizon + 1)
    numbers = numbers.clamp(min=0).to(true.places.device)
    rows = rows.to(true.places.device)
    present = true.present[rows, 0]
    most = int(present.sum(1).max().clamp(min=1))
    kept = present.argsort(dim=1, descending=True, stable=True)[:, :most]

    def of_bodies(values: Tensor) -> Tensor:
        return values[rows[:, None], numbers].take_along_dim(kept[:, None], 2)

    places, turns = of_bodies(true.places), of_bodies(true.turns)
    spin = angle_of_code(turned_back(turns[:, 1], turns[:, 0]), folds)[..., None]
    window = Poses(
        true.agents[rows[:, None], numbers][:, 1:],
        present.take_along_dim(kept, 1)[:, None].expand(-1, horizon + 1, -1, -1),
        places[:, 1:],
        turns[:, 1:],
    )
    return window, (places[:, 1] - places[:, 0], spin)


def _chosen(
    true: Poses, horizon: int, wanted: int, random: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Clips and first frames of windows."""
    clips, frames = true.places.shape[:2]
    tries = 4 * wanted
    rows = torch.randint(clips, (tries,), generator=random)
    starts = torch.randint(frames - horizon, (tries,), generator=random)
    moves = (true.places.diff(dim=1).abs().sum(-1) > MOVES).any(-1).cpu()
    inside = starts[:, None] + torch.arange(horizon)
    kept = moves[rows[:, None], inside].any(1) | (torch.rand(tries, generator=random) < STILL)
    chosen = kept.nonzero()[:wanted, 0]
    if not len(chosen):
        chosen = torch.arange(wanted)
    return rows[chosen], starts[chosen]
