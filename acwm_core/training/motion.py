"""Teaches how actions move the agent from states and actions alone, before the first picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from acwm_core.data.clips import Clips
from acwm_core.errors import TrainingError
from acwm_core.executors import progress_bar
from acwm_core.model.world_model import WorldModel

CLIPS = 128
"""Clips per step, or all if there are fewer."""

RATE, WARMUP, CLIPPED = 3e-3, 100, 0.5
"""Peak learning rate, the steps until it is reached, and the largest norm of the gradient."""


def learn_motion(
    world_model: WorldModel, clips: Clips, steps: int, *, seed: int, shown: bool
) -> None:
    """Train by `WorldModel.motion_loss` all that it depends on, and then keep that as it is.

    Without pictures a step costs little, so that it sees each clip many times.

    Args:
        world_model: its states have their scale already.
        clips: with actions and states; those of the commonest length are used.
        steps: 0 only marks what was learnt before, as a resumed run does.
        seed: of the order of the clips and of the noise.
        shown: whether to show the progress.

    Raises:
        TrainingError: the loss stopped being finite.
    """
    batches = _batches(world_model, clips, seed)
    random = torch.Generator().manual_seed(seed)
    learnt = _depends(world_model, *next(batches), random)
    optimizer: Any = torch.optim.AdamW(learnt, RATE, weight_decay=1e-3)
    loss = torch.zeros(())
    bar = progress_bar(
        "the agent's motion", steps, unit="steps", shown=shown, note=lambda: f"loss {loss:.4f}"
    )
    with bar as report:
        for step in range(steps):
            for group in optimizer.param_groups:
                group["lr"] = RATE * min(1, (step + 1) / WARMUP, 1.6 * (1 - step / steps))
            optimizer.zero_grad()
            loss = world_model.motion_loss(*next(batches), random, progress=step / steps)
            cast(Any, loss).backward()
            if not nn.utils.clip_grad_norm_(learnt, CLIPPED).isfinite():
                raise TrainingError(
                    f"the loss of the agent's motion is not finite in step {step + 1} of "
                    "training.agent_steps: look at data.states"
                )
            optimizer.step()
            report(1)
    for parameter in learnt:
        parameter.grad = None
        parameter.requires_grad_(False)


def _batches(world_model: WorldModel, clips: Clips, seed: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Actions and states of clips drawn at random, without end."""
    lengths, counts = np.unique(clips.lengths, return_counts=True)
    alike = np.flatnonzero(clips.lengths == lengths[counts.argmax()])
    held = clips.inputs(alike.tolist())
    actions, states = (held[name].to(world_model.device) for name in ("actions", "states"))
    random = torch.Generator().manual_seed(seed + 1)
    while True:
        chosen = torch.randint(len(alike), (min(CLIPS, len(alike)),), generator=random)
        chosen = chosen.to(world_model.device)
        yield actions[chosen], states[chosen]


def _depends(
    world_model: WorldModel, actions: Tensor, states: Tensor, random: torch.Generator
) -> Sequence[nn.Parameter]:
    """The weights on which the loss of the motion depends."""
    weights = [each for each in world_model.parameters() if each.requires_grad]
    loss = world_model.motion_loss(actions, states, random, progress=0)
    gradients = cast(Sequence[Tensor | None], torch.autograd.grad(loss, weights, allow_unused=True))
    return [each for each, of_it in zip(weights, gradients, strict=True) if of_it is not None]
