"""Videos of a policy: what it did in the simulator beside what it does in the dream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from acwm_core.env.task import Task, judged
from acwm_core.evaluation.clips import as_clip
from acwm_core.model.shapes import Clip
from acwm_core.training.run import RunBundle
from acwm_dream.starts import DreamStart
from acwm_planning.episode import EpisodeResult
from acwm_planning.predicted import observation_of
from acwm_planning.video import draw_curves, write_episode
from acwm_policy.scenes import DreamScenes, as_arrays

PANELS = ["simulator", "dream", "goal"]
"""What stands side by side."""


def write_video(
    path: Path,
    row: str,
    seed: int,
    result: EpisodeResult,
    bundle: RunBundle,
    task: Task,
    start: DreamStart | None,
    decided: Sequence[Tensor] = (),
) -> None:
    """Write a video of an episode, and its distances from the goal.

    It ends with the episode of the simulator. A dream that is solved earlier stands still then.

    Args:
        path: the MP4 file.
        row: who acted.
        seed: number of the episode.
        result: the episode in the simulator.
        bundle: the model.
        task: the task.
        start: what the dream began with; None without a dream.
        decided: what the policy decided in the dream, raw actions `[A]` for a latent frame each.
    """
    curves = draw_curves(row, seed, result, task, bundle.card.fps)
    if start is None:
        write_episode(path, result, curves, None)
        return
    shown, length = drawn_dream(bundle, start, decided), len(result.history.frames)
    shown = torch.cat([shown, shown[-1:].expand(length, -1, -1, -1)])[:length]
    distances = [float(f"{value:.4g}") for value in dreamt_distances(bundle, task, start, decided)]
    known = [value if np.isfinite(value) else None for value in distances]
    write_episode(path, result, replace(curves, panels=PANELS, imagined=known), shown)


def drawn_dream(bundle: RunBundle, start: DreamStart, decided: Sequence[Tensor]) -> Clip:
    """The frames of a dream as the model draws them, `[1 + T, 3, H, W]`; the first is given."""
    world, device = bundle.world_model, bundle.world_model.device
    held = torch.stack([*decided]).repeat_interleave(world.codec.temporal_stride, 0)
    rows = torch.cat([torch.from_numpy(start.actions), held, torch.zeros_like(held[:1])])
    given = as_clip(start.frames)[None].to(device)
    frames = world.rollout(given, rows[None].to(device), seeds=[0], check=False)
    return frames[0, len(start.frames) - 1 :].cpu()


def dreamt_distances(
    bundle: RunBundle, task: Task, start: DreamStart, decided: Sequence[Tensor]
) -> NDArray[np.float64]:
    """The distance from the goal in every frame of a dream, `[1 + T]`."""
    assert start.goal is not None
    scenes = DreamScenes(bundle.world_model, [start], 1)
    first, _ = scenes.begin([0], [0])
    moved = [as_arrays(scenes.move(action[None])) for action in decided]
    states = {
        name: np.concatenate([first[name], *(step[name][0] for step in moved)]) for name in first
    }
    count = len(next(iter(states.values())))
    return judged(task, "distance", observation_of(states, count), start.goal)
