"""Teaches a scene what its points are, from pairs of frames of one clip."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.optim import AdamW

from acwm_core.model.objectives.objective import TrainingClips
from acwm_core.training.muon import Float32Muon
from acwm_scene.points import PointGroup
from acwm_scene.scene import SceneDynamics
from acwm_scene.stage import Stage

CLIPS, DRAWN = 8, 4
"""Clips per step, and frames of each that are drawn on another one of it."""

RATE, MATRIX_RATE = 2e-3, 4e-3
"""Peak learning rates of AdamW and of Muon."""

POINTS = Stage("finding points", "objective.point_steps", warmup=50, decay=1.25, clipped=1.0)

MEASURED_CLIPS, READ_AT_ONCE = 256, 64
"""Clips whose frames make up the average frame, and clips that are read at once."""

PROBED, PROBE = 48, 0.1
"""Pairs of frames, and standard deviations, by which it is measured what the drawing cares for."""


def learn_points(model: SceneDynamics, clips: TrainingClips, steps: int) -> None:
    """Train what finds points, and what draws them, and then keep what finds them as it is.

    A frame is drawn on another one of the clip, from the points that were read in both. All that
    differs between the two has to pass through the points; so these come to be where things are.

    Args:
        model: with points.
        clips: their latents and states; each is seen many times.
        steps: 0 only marks what was learnt before, as a resumed run does.

    Raises:
        TrainingError: the loss stopped being finite.
    """
    points = cast(PointGroup, model.points)
    if steps:
        device = clips.states.device
        model.to(device)
        random = torch.Generator().manual_seed(clips.seed)
        rows = torch.randperm(len(clips.states), generator=random)[:MEASURED_CLIPS]
        points.sight.measure(clips.latents(rows).float().mean((0, 1)))
        training = model.training
        _train(model.train(), clips, steps, random)
        _measure(model.eval(), points, clips, random)
        model.train(training)  # as the trainer keeps it
    for parameter in points.sight.parameters():
        parameter.requires_grad_(False)


def states_with_points(model: SceneDynamics, clips: TrainingClips) -> Tensor:
    """The states of all clips with the points that the model reads, `[N, T, S + point_size]`."""
    if model.points is None:
        return clips.states
    rows = torch.arange(len(clips.states)).split(READ_AT_ONCE)
    with torch.no_grad():
        return torch.cat(
            [model.with_points(clips.states[part], clips.latents(part).float()) for part in rows]
        )


def _train(model: SceneDynamics, clips: TrainingClips, steps: int, random: torch.Generator) -> None:
    matrices = model.matrices()
    numbers = {id(matrix) for matrix in matrices}
    others = [
        parameter
        for parameter in model.parameters()
        if parameter.requires_grad and id(parameter) not in numbers
    ]
    muon = Float32Muon(matrices, weight_decay=0.01, adjust_lr_fn="match_rms_adamw")
    optimizers = [
        (AdamW(others, betas=(0.9, 0.99), weight_decay=0.01), RATE),
        (muon, MATRIX_RATE),
    ]
    POINTS.train(
        lambda _: pair_loss(model, clips, random), optimizers, steps, shown=clips.shows_progress
    )


def pair_loss(model: SceneDynamics, clips: TrainingClips, random: torch.Generator) -> Tensor:
    """The error of some frames of clips that are drawn on another one of the same clip.

    Half of these others are the first of a clip, on which predictions are drawn.
    """
    rows = torch.randint(len(clips.states), (min(CLIPS, len(clips.states)),), generator=random)
    whole = clips.latents(rows)
    frames = torch.randint(whole.shape[1], (len(rows), 1 + DRAWN), generator=random)
    frames[: len(rows) // 2, 0] = 0
    latents, states = _rearranged(model, whole, clips.states[rows], frames)
    latent_frames = model.draw_true(latents[:, :1], states, _numbers(latents))
    return functional.mse_loss(latent_frames, latents[:, 1:])


def _rearranged(
    model: SceneDynamics, latents: Tensor, states: Tensor, frames: Tensor
) -> tuple[Tensor, Tensor]:
    """Clips of other latent frames `[B, N]` of the same clips, and their states with points."""
    frames = frames.to(latents.device)
    latents = latents.take_along_dim(frames[..., None, None, None], 1).float()
    within = torch.arange(1 - model.stride, 1, device=frames.device)
    video = (frames[..., None] * model.stride + within).flatten(1)[:, model.stride - 1 :]
    states = states.take_along_dim(video.clamp(min=0)[..., None], 1)
    return latents, model.with_points(states, latents)


def _numbers(latents: Tensor) -> Tensor:
    """The numbers of all frames after the first one."""
    return torch.arange(latents.shape[1] - 1, device=latents.device).expand(len(latents), -1)


@torch.no_grad()
def _measure(
    model: SceneDynamics, points: PointGroup, clips: TrainingClips, random: torch.Generator
) -> None:
    """Tell the points their scale, and what an error of each of their numbers costs the drawing."""
    rows = torch.randperm(len(clips.states), generator=random)[:MEASURED_CLIPS]
    whole = clips.latents(rows)
    read = points.sight(whole.flatten(0, 1).float())
    std = read.std(0).clamp(min=0.02)
    chosen = torch.randint(len(rows), (PROBED,), generator=random)
    frames = torch.randint(whole.shape[1], (PROBED, 2), generator=random)
    frames[:, 0] = 0
    latents, states = _rearranged(model, whole[chosen], clips.states[rows[chosen]], frames)

    def picture_of(states: Tensor) -> Tensor:
        return model.draw_true(latents[:, :1], states, _numbers(latents))

    reference, costs = picture_of(states), torch.zeros_like(std)
    for point, entry in np.ndindex(*std.shape):
        other = states.clone()
        column = model.columns["points"][point * std.shape[1] + entry]
        other[:, 1:, column] += PROBE * std[point, entry]
        costs[point, entry] = (picture_of(other) - reference).square().mean().sqrt()
    points.measure(read, costs)
