"""Teaches how actions move a scene from states and actions alone, before the first picture."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn

from acwm_core.errors import TrainingError
from acwm_core.executors import progress_bar
from acwm_core.model.objectives.objective import TrainingClips
from acwm_scene.scene import SceneDynamics

CLIPS = 128
"""Clips per step, or all if there are fewer."""

RATE, WARMUP, CLIPPED = 3e-3, 100, 0.5
"""Peak learning rate, the steps until it is reached, and the largest norm of the gradient."""


def learn_motion(model: SceneDynamics, clips: TrainingClips, states: Tensor, steps: int) -> None:
    """Train what moves the scene and what embeds its actions, and then keep them as they are.

    Args:
        model: knows the scale of its states already.
        clips: their actions; each is seen many times.
        states: of the clips, with what was read of their points, `[N, T, S + point_size]`.
        steps: 0 only marks what was learnt before, as a resumed run does.

    Raises:
        TrainingError: the loss stopped being finite.
    """
    model.to(states.device)
    parameters = [*model.motion_parameters(), *clips.conditioner_parameters()]
    optimizer: Any = torch.optim.AdamW(parameters, RATE, weight_decay=1e-3)
    random = torch.Generator().manual_seed(clips.seed)
    order = torch.Generator().manual_seed(clips.seed + 1)
    loss = torch.zeros(())
    bar = progress_bar(
        *("how things move", steps),
        unit="steps",
        shown=clips.shows_progress,
        note=lambda: f"loss {loss:.4f}",
    )
    with bar as report:
        for step in range(steps):
            for group in optimizer.param_groups:
                group["lr"] = RATE * min(1, (step + 1) / WARMUP, 1.6 * (1 - step / steps))
            optimizer.zero_grad()
            rows = torch.randint(len(states), (min(CLIPS, len(states)),), generator=order)
            rows = rows.to(states.device)
            conditioning = clips.conditioning(rows)
            loss = model.motion_loss(states[rows], conditioning, random, progress=step / steps)
            cast(Any, loss).backward()
            if not nn.utils.clip_grad_norm_(parameters, CLIPPED).isfinite():
                raise TrainingError(
                    f"the loss of how things move is not finite in step {step + 1} of "
                    "objective.motion_steps: look at data.states"
                )
            optimizer.step()
            report(1)
    for parameter in parameters:
        parameter.grad = None
        parameter.requires_grad_(False)
