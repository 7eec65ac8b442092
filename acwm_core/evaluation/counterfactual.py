"""Counterfactual test: other actions from the same first frame, simulated and predicted."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.data.simulate import simulate
from acwm_core.environment import ActionSpec, Environment
from acwm_core.episode import Episode
from acwm_core.evaluation.action_response import ActionResponses, Branch
from acwm_core.evaluation.clips import (
    Batch,
    ClipPlan,
    Predictor,
    as_clip,
    cut_episode,
    load_samples,
)
from acwm_core.evaluation.evaluator import Evaluator, ShownClip
from acwm_core.evaluation.results import Counterfactual, VideoRecord
from acwm_core.evaluation.videos import case_study
from acwm_core.metric import Metric, Rollout
from acwm_core.shapes import Clip

ROWS: tuple[Predictor, ...] = ("model", "codec")
"""What responds: the model, and the codec's reconstruction of the true responses, its ceiling. The
simulator itself would have a response of 1, the first frame standing still one of 0."""

SIZES = (0.1, 0.5)
"""Shifts of one dimension, as shares of half its range."""

ActionRows = NDArray[np.float32]
"""Raw actions `[T, A]`; the last row leads to no frame and is zero."""


@dataclass(frozen=True)
class Fan:
    """A clip and its branches, as simulated.

    Attributes:
        plan: which clip it is.
        factual: the clip, simulated once more.
        branches: what each branch asks for.
        episodes: what came of it, in the same order.
    """

    plan: ClipPlan
    factual: Episode
    branches: list[Branch]
    episodes: list[Episode]


def max_branches(spec: ActionSpec) -> int:
    """How many branches `plan_branches` plans at most."""
    return 4 + len(SIZES) * spec.size


def plan_branches(
    actions: ActionRows, another: ActionRows, still: NDArray[np.float32], spec: ActionSpec
) -> list[Branch]:
    """All branches of a clip, without those that ask for what the clip itself asks for.

    * ``another``: another episode's actions.
    * ``still``: nothing moves.
    * ``reversed``: the clip's actions in reversed order.
    * ``mirrored``: the opposite of each action, 2·still − action, as far as the bounds allow.
    * for each dimension and each of `SIZES`: the action, shifted throughout; to the side on which
      the bounds leave more of the shift.

    Args:
        actions: of the clip, `[T, A]`.
        another: of the other episode, `[T, A]`.
        still: the action `[A]` that asks for no motion at the start.
        spec: names and bounds.
    """
    taken = actions[:-1]
    low, high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
    asked: list[tuple[str, ActionRows, float]] = [
        ("another", another[:-1], 0.0),
        ("still", np.tile(still, (len(taken), 1)), 0.0),
        ("reversed", taken[::-1], 0.0),
        ("mirrored", np.clip(2 * still - taken, low, high), 0.0),
        *(
            (name, _shifted(taken, dimension, size, spec), size)
            for dimension, name in enumerate(spec.names)
            for size in SIZES
        ),
    ]
    last = np.zeros((1, spec.size))
    branches = [
        Branch(kind, np.concatenate([rows, last]).astype(np.float32), size)
        for kind, rows, size in asked
    ]
    return [branch for branch in branches if not np.array_equal(branch.actions, actions)]


def _shifted(taken: ActionRows, dimension: int, size: float, spec: ActionSpec) -> ActionRows:
    low, high = spec.low[dimension], spec.high[dimension]
    values, step = taken[:, dimension], size * (high - low) / 2
    up, down = np.clip(values + step, low, high), np.clip(values - step, low, high)
    rows = taken.copy()
    rows[:, dimension] = up if (up - values).sum() >= (values - down).sum() else down
    return rows


def simulate_fans(
    environment: Environment, plans: Sequence[ClipPlan], episodes: EpisodeDataset, frames: int
) -> Iterator[Fan]:
    """Simulate each clip, at most `frames` long, and its branches."""
    for sample in load_samples(plans, episodes):
        clip = cut_episode(sample.episode, 0, min(frames, len(sample.video)))
        length = len(clip.video)
        environment.reset(options={"spec": clip.spec})
        branches = plan_branches(
            clip.actions,
            sample.donor_actions[:length],
            environment.still_action(),
            environment.card.action,
        )
        asked = [clip.actions, *(branch.actions for branch in branches)]
        made = [simulate(environment, clip.spec, rows, frames=length) for rows in asked]
        yield Fan(sample.plan, made[0], branches, made[1:])


def counterfactual(
    evaluator: Evaluator,
    metrics: Mapping[str, Metric],
    fans: Iterator[Fan],
    advance: Callable[[int], None] | None = None,
) -> tuple[Counterfactual, list[ShownClip]]:
    """Predict clips and their branches with the same noise, and compare the responses.

    Args:
        evaluator: predicts.
        metrics: of branches, by registered name.
        fans: of one split.
        advance: told how many videos more were predicted.

    Returns:
        What was found, and a video of each branch of the first clip.
    """
    responses = ActionResponses(metrics, evaluator.card.action, evaluator.config.seed)
    videos: list[ShownClip] = []
    for fan in fans:
        truth = [as_clip(each.video) for each in (fan.factual, *fan.episodes)]
        for row in ROWS:
            rollout = _rollout(evaluator, fan, truth, row, advance)
            responses.add(row, fan.plan, rollout, fan.branches)
            if row == "model" and not videos:
                videos = _videos(rollout, fan)
    return responses.summary(), videos


def _rollout(
    evaluator: Evaluator,
    fan: Fan,
    truth: Sequence[Clip],
    row: Predictor,
    advance: Callable[[int], None] | None,
) -> Rollout:
    """The clip as one row predicts it, with its branches, all with the noise of one seed."""
    asked = [fan.factual.actions, *(branch.actions for branch in fan.branches)]
    predicted: list[Clip] = []
    size, device = evaluator.config.batch_size, evaluator.device
    for first in range(0, len(asked), size):
        video = torch.stack(list(truth[first : first + size])).to(device)
        actions = torch.as_tensor(np.stack(asked[first : first + size]), device=device)
        batch = Batch(video, actions, actions, [fan.plan.seed] * len(video))
        predicted += evaluator.predict(batch, [row])[row]
        if advance:
            advance(len(video))
    made = [
        Rollout.of(episode, true, video, evaluator.card)
        for episode, true, video in zip((fan.factual, *fan.episodes), truth, predicted, strict=True)
    ]
    return replace(made[0], estimator=evaluator.estimator, branches=tuple(made[1:]))


def _videos(rollout: Rollout, fan: Fan) -> list[ShownClip]:
    """Truth, prediction and difference of the clip, and of its branches of the largest sizes."""
    largest = max((branch.size for branch in fan.branches), default=0.0)
    shown = [("factual", rollout)] + [
        (branch.kind, each)
        for branch, each in zip(fan.branches, rollout.branches, strict=True)
        if branch.size in (0.0, largest)
    ]
    return [_video(fan, number, kind, each) for number, (kind, each) in enumerate(shown)]


def _video(fan: Fan, number: int, kind: str, rollout: Rollout) -> ShownClip:
    plan = fan.plan
    panels, frames = case_study(rollout.target, rollout.prediction, rollout.masks)
    record = VideoRecord(
        file=f"{plan.split}-{plan.episode:06d}-branch-{number:02d}.mp4",
        split=plan.split,
        episode=plan.episode,
        ood_label=fan.factual.ood_label,
        pick="counterfactual",
        kind=f"branch:{kind}",
        values={},
        actions=rollout.actions.tolist(),
        panels=panels,
    )
    return record, frames
