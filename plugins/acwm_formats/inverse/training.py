"""Trains a network on moments of episodes, drawn at random."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from acwm_core.executors import progress_bar
from acwm_formats.inverse.network import window

BATCH = 32
RATE = 2e-3

Moment = tuple[int, int]
"""An episode, and a frame of it that is not the last."""


def train_on_moments(
    network: nn.Module,
    frames: Sequence[Tensor],
    loss_of_batch: Callable[[Tensor, Sequence[Moment]], Tensor],
    *,
    steps: int,
    seed: int,
    what: str,
    progress: bool,
) -> None:
    """Take steps of AdamW on batches of `BATCH` moments.

    Args:
        network: its weights are trained.
        frames: of each episode, `[T, 3, h, w]` uint8.
        loss_of_batch: the loss of windows `[B, len(CONTEXT), 3, h, w]` around these moments.
        steps: number of steps.
        seed: of the order.
        what: label of the progress bar.
        progress: whether to show it.
    """
    moments = [(e, k) for e, video in enumerate(frames) for k in range(len(video) - 1)]
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, steps, pct_start=0.1)
    rng = torch.Generator().manual_seed(seed)
    with progress_bar(what, steps, unit="steps", shown=progress) as report:
        for _ in range(steps):
            places = torch.randint(len(moments), (BATCH,), generator=rng).tolist()
            batch = [moments[place] for place in places]
            loss = loss_of_batch(torch.stack([window(frames[e], k) for e, k in batch]), batch)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            report(1)
