"""Films of plans: what was imagined beside what happened, and the goal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.video import write_mp4
from acwm_core.evaluation import videos
from acwm_core.shapes import Clip
from acwm_planning.episode import Played
from acwm_planning.futures import History, ModelRollouts


def imagined(played: Played, rollouts: ModelRollouts, still: NDArray[np.float32]) -> Clip:
    """What the model expected of the actions that were taken, `[T, 3, H, W]`.

    After every decision it begins again from what had happened by then; the first frame is true.
    """
    history, decisions = played.history, played.decisions
    first = torch.from_numpy(history.frames[0]).permute(2, 0, 1)[None].float() / 255
    clips = [first]
    ends = [*(each.frame for each in decisions[1:]), len(history.actions)]
    for decision, end in zip(decisions, ends, strict=True):
        now = decision.frame
        by_then = History(history.spec, history.frames[: now + 1], history.actions[:now])
        clip = rollouts.imagined(by_then, still, decision.plan.actions, decision.seed)
        clips.append(clip[: end - now])
    return torch.cat(clips)


def write_film(path: Path, played: Played, fps: int, expected: Clip | None = None) -> None:
    """Write an episode as MP4: what happened, what a model imagined if one did, and the goal."""
    happened = np.stack(played.history.frames)
    goal = np.broadcast_to(played.goal.frame, happened.shape)
    panels = [happened, *([videos.to_pixels(expected)] if expected is not None else []), goal]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_mp4(path, videos.join(panels), fps, videos.magnification(happened.shape[1]))
