"""Teaches how actions move a scene from states and actions alone, before the first picture."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.optim import AdamW

from acwm_core.model.objectives.objective import TrainingClips
from acwm_scene.scene import SceneDynamics
from acwm_scene.stage import Stage

CLIPS = 128
"""Clips per step, or all if there are fewer."""

RATE = 3e-3
"""Peak learning rate."""

MOTION = Stage("learning motion", "objective.motion_steps", warmup=100, decay=1.6, clipped=0.5)


def learn_motion(model: SceneDynamics, clips: TrainingClips, states: Tensor, steps: int) -> None:
    """Train what moves the scene and what embeds its actions, and then keep them as they are.

    Args:
        model: knows the scale of its states already.
        clips: their actions; each is seen many times, or as often as its actions weigh.
        states: of the clips, with what was read of their points, `[N, T, S + point_size]`.
        steps: 0 only marks what was learnt before, as a resumed run does.

    Raises:
        TrainingError: the loss stopped being finite.
    """
    model.to(states.device)
    parameters = [*model.motion_parameters(), *clips.conditioner_parameters()]
    random = torch.Generator().manual_seed(clips.seed)
    order = torch.Generator().manual_seed(clips.seed + 1)

    count = min(CLIPS, len(states))
    weights = None if clips.weights is None else clips.weights[:, :-1].mean(1).cpu()

    def loss_of(step: int) -> Tensor:
        if weights is None:
            rows = torch.randint(len(states), (count,), generator=order)
        else:
            rows = torch.multinomial(weights, count, replacement=True, generator=order)
        rows = rows.to(states.device)
        conditioning = clips.conditioning(rows)
        return model.motion_loss(states[rows], conditioning, random, progress=step / steps)

    optimizers = [(AdamW(parameters, RATE, weight_decay=1e-3), RATE)]
    MOTION.train(loss_of, optimizers, steps, shown=clips.shows_progress)
    for parameter in parameters:
        parameter.requires_grad_(False)
