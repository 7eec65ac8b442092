"""Videos of plans: what happened beside what the model imagined, and distances from the goal."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.pictures import magnification, to_pixels
from acwm_core.data.video import write_mp4
from acwm_core.env.physics import StateEstimator
from acwm_core.env.task import Task, judged
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.videos import join_panels
from acwm_core.files import writing, written_whole
from acwm_core.model.shapes import Clip
from acwm_planning.episode import EpisodeResult
from acwm_planning.futures import History, ModelRollouts
from acwm_planning.results import EpisodeCurves, PlannedDistances

PANEL = 192
"""Approximate height of the encoded panels, in pixels."""

DIGITS = 4
"""Significant digits of the distances in the JSON file."""


@dataclass(frozen=True)
class Imagined:
    """What a model predicted during an episode.

    Attributes:
        clip: prediction for the actions that were taken, `[T, 3, H, W]`. It restarts from the real
            frames at every decision; the first frame is real.
        plans: for each decision, its frame and the predicted clip of its whole plan, with one
            picture per latent frame. Later decisions may have replaced the rest of the plan.
    """

    clip: Clip
    plans: list[tuple[int, Clip]]


def imagine(result: EpisodeResult, rollouts: ModelRollouts, still: NDArray[np.float32]) -> Imagined:
    """What the model predicted for the actions that were taken, and for those that were planned."""
    history, decisions = result.history, result.decisions
    first = as_clip(history.frames[0][None])
    clips, plans = [first], list[tuple[int, Clip]]()
    ends = [*(decision.frame for decision in decisions[1:]), len(history.actions)]
    stride = rollouts.world_model.codec.temporal_stride
    for decision, end in zip(decisions, ends, strict=True):
        now = decision.frame
        past = History(history.spec, history.frames[: now + 1], history.actions[:now])
        clip = rollouts.imagine(past, still, decision.plan.actions, decision.seed)
        clips.append(clip[: end - now])
        plans.append((now, clip[stride - 1 :: stride]))
    return Imagined(torch.cat(clips), plans)


def draw_curves(
    row: str,
    seed: int,
    result: EpisodeResult,
    task: Task,
    fps: float,
    imagined: Imagined | None = None,
    estimator: StateEstimator | None = None,
    stride: int = 1,
) -> EpisodeCurves:
    """The curves of a video.

    Args:
        row: who acted.
        seed: number of the episode.
        result: the episode.
        task: defines the distances.
        fps: frames per second of the video.
        imagined: predictions of the model, if a model planned.
        estimator: estimator that reads the predicted frames, if there is one.
        stride: frames between two pictures of a plan.
    """
    distances, plans = list[float | None](), list[PlannedDistances]()

    def read(clip: Clip) -> list[float | None]:
        assert estimator is not None
        return _rounded(judged(task, "distance", estimator.read(clip), result.goal))

    if imagined is not None and estimator is not None:
        distances = read(imagined.clip)
        for now, clip in imagined.plans:
            frames = [now + stride * (n + 1) for n in range(len(clip))]
            plans.append(PlannedDistances(frames, read(clip) if len(clip) else []))
    return EpisodeCurves(
        row=row,
        seed=seed,
        success=result.success,
        failed=result.failed,
        unit=task.unit,
        tolerance=task.tolerance,
        fps=fps,
        panels=["happened", *(["imagined"] if imagined is not None else []), "goal"],
        distances=_rounded(result.distances),
        imagined=distances,
        plans=plans,
    )


def write_episode(
    path: Path, result: EpisodeResult, curves: EpisodeCurves, imagined: Clip | None
) -> None:
    """Write an episode as MP4, panel by panel, and its curves as a JSON file next to it."""
    happened = np.stack(result.history.frames)
    goal = np.broadcast_to(result.goal.frame, happened.shape)
    panels = [happened, *([to_pixels(imagined)] if imagined is not None else []), goal]
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    times = magnification(happened.shape[1], PANEL)
    write_mp4(path, join_panels(panels), curves.fps, times)
    with writing(path), written_whole(path.with_suffix(".json")) as partial:
        partial.write_text(json.dumps(asdict(curves), allow_nan=False), encoding="utf-8")


def _rounded(values: Iterable[float]) -> list[float | None]:
    """Round to `DIGITS` significant digits; None for values that are not finite."""
    return [float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in values]
