"""Tests that need the simulator: predictability horizons, and the effect of other actions."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.environment import ActionSpec, Environment
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import AcwmError, DataError
from acwm_core.evaluation.clips import Clip, as_clip, cut_episode, donor_actions, read_clips
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.protocol import protocol_named
from acwm_core.evaluation.responses import (
    ROWS,
    ActionRows,
    Branch,
    Simulated,
    counterfactual,
    pooled,
    ratio,
)
from acwm_core.evaluation.results import Counterfactual, Predictability, Score
from acwm_core.evaluation.score import build_metrics, score, split_available
from acwm_core.evaluation.statistics import finite
from acwm_core.evaluation.videos import ShownClip
from acwm_core.model.world_model import CLIP_FRAMES

SIZES = (0.1, 0.5)
"""Shifts of one action dimension, as fractions of half its range."""

COUNTERFACTUAL, PERTURBED = "counterfactual", "perturbed"
"""Names of the two tests in `Summary.left_out`."""

TRIED_FRAMES = 8
"""How many frames of the first episode the simulator must reproduce."""

UNPREDICTABLE = 0.5
"""From this share on a frame counts as unpredictable: its squared error relative to that of
repeating the first frame. Another episode of the same world has about 2, a perfect copy 0."""

Clips = Mapping[str, Sequence[Clip]]
"""Clips by split."""


@dataclass(frozen=True)
class Interventions:
    """What the simulator has shown, by split, and why a test or metric was left out, by its name.

    The scores are of the kind ``perturbed``; the videos show branches.
    """

    scores: dict[str, list[Score]] = field(default_factory=dict[str, list[Score]])
    predictability: dict[str, Predictability] = field(default_factory=dict[str, Predictability])
    counterfactual: dict[str, Counterfactual] = field(default_factory=dict[str, Counterfactual])
    videos: list[ShownClip] = field(default_factory=list[ShownClip])
    left_out: dict[str, str] = field(default_factory=dict[str, str])


def simulator_of(episodes: EpisodeDataset) -> Environment:
    """The environment that simulated these episodes.

    Raises:
        DataError: there is none: the data was recorded, or the simulator is not installed or has
            changed.
    """
    card = episodes.card
    if card.source:
        raise DataError("the data was recorded, so there is no simulator for it")
    try:
        environment = make_environment(card.environment.name, card.options)
    except AcwmError as error:
        raise DataError(f"its simulator is not available ({error})") from error
    first = episodes[0]
    frames = min(TRIED_FRAMES, len(first.video))
    again = simulate(environment, first.spec, first.actions[:frames], frames=frames)
    if np.abs(again.video - first.video[:frames].astype(float)).mean() > 1:  # beyond rounding
        environment.close()
        raise DataError(
            "the installed simulator does not reproduce the videos of the data: generate the data "
            "again"
        )
    return environment


def asked_clips(evaluator: Evaluator, clips: Clips) -> dict[str, Clips]:
    """The clips of each test, by test and split.

    The counterfactual test takes the first clips that start at their episode's first frame. The
    perturbed test takes the first clips, but none under a protocol whose clips may start later.
    """
    config = evaluator.config
    moved = config.perturbed_episodes * protocol_named(config.protocol).from_first_frame
    return {
        COUNTERFACTUAL: {
            split: [clip for clip in each if clip.start == 0][: config.counterfactual_episodes]
            for split, each in clips.items()
        },
        PERTURBED: {split: each[:moved] for split, each in clips.items()},
    }


def units_of_work(evaluator: Evaluator, clips: Clips) -> int:
    """Upper bound of the progress that `intervene` reports to `Evaluator.advance`, in rows."""
    branches = len(ROWS) * (1 + max_branches(evaluator.card.action))
    count = {n: sum(map(len, each.values())) for n, each in asked_clips(evaluator, clips).items()}
    return branches * count[COUNTERFACTUAL] + count[PERTURBED]


def intervene(
    evaluator: Evaluator, clips: Clips, datasets: Mapping[str, EpisodeDataset]
) -> Interventions:
    """Run the tests that need the simulator, if it is available and the config asks for them."""
    config, found = evaluator.config, Interventions()
    metrics = build_metrics(config.counterfactual_metrics, config.metric_options, of_branches=True)
    asked = {n: s for n, s in asked_clips(evaluator, clips).items() if any(s.values())}
    if not metrics:
        asked.pop(COUNTERFACTUAL, None)
    if not asked:
        return found
    try:
        environment = simulator_of(next(iter(datasets.values())))
    except DataError as error:
        found.left_out.update(dict.fromkeys(sorted(asked), str(error)))
        return found
    with contextlib.closing(environment):
        if PERTURBED in asked and not environment.can_be_perturbed:
            found.left_out[PERTURBED] = f"{evaluator.card.name} has no perturbed start"
            del asked[PERTURBED]
        for split, few in asked.get(COUNTERFACTUAL, {}).items():
            if few:
                usual = evaluator.given + CLIP_FRAMES - 1
                frames = min(evaluator.world_model.clip_frames, usual)
                kept, left_out = split_available(metrics, evaluator.card, evaluator.estimator)
                found.left_out.update(left_out)
                simulated = simulate_branches(
                    environment, few, datasets[split], frames, evaluator.estimator
                )
                found.counterfactual[split], videos = counterfactual(evaluator, kept, simulated)
                found.videos.extend(videos if config.videos else ())
        for split, few in asked.get(PERTURBED, {}).items():
            found.scores[split], found.predictability[split] = perturbed(
                evaluator, environment, few, datasets[split]
            )
    return found


def max_branches(spec: ActionSpec) -> int:
    """The largest number of branches that `plan_branches` returns."""
    return 4 + len(SIZES) * spec.size


def plan_branches(
    actions: ActionRows, another: ActionRows, still: NDArray[np.float32], spec: ActionSpec
) -> list[Branch]:
    """All branches of a clip, without those whose actions equal the clip's own.

    * ``another``: another episode's actions.
    * ``still``: nothing moves.
    * ``reversed``: the clip's actions in reversed order.
    * ``mirrored``: the opposite of each action, 2·still − action, clipped to the bounds.
    * for each dimension and each of `SIZES`: the actions with this dimension shifted in all frames,
      in the direction in which the bounds cut off less of the shift.
    """
    taken = actions[:-1]
    low, high = np.array(spec.low, np.float32), np.array(spec.high, np.float32)
    asked: list[tuple[str, ActionRows, float]] = [
        ("another", another[:-1], 0.0),
        ("still", np.tile(still, (len(taken), 1)), 0.0),
        ("reversed", taken[::-1], 0.0),
        ("mirrored", np.clip(2 * still - taken, low, high), 0.0),
    ]
    for (dimension, name), size in itertools.product(enumerate(spec.names), SIZES):
        values, bounds = taken[:, dimension], (spec.low[dimension], spec.high[dimension])
        step = size * (bounds[1] - bounds[0]) / 2
        up, down = np.clip(values + step, *bounds), np.clip(values - step, *bounds)
        rows = taken.copy()
        rows[:, dimension] = up if (up - values).sum() >= (values - down).sum() else down
        asked.append((name, rows, size))
    last = np.zeros((1, spec.size))
    branches = [
        Branch(kind, np.concatenate([rows, last]).astype(np.float32), size)
        for kind, rows, size in asked
    ]
    return [branch for branch in branches if not np.array_equal(branch.actions, actions)]


def simulate_branches(
    environment: Environment,
    clips: Sequence[Clip],
    episodes: EpisodeDataset,
    frames: int,
    estimator: StateEstimator | None = None,
) -> Iterator[Simulated]:
    """Simulate each clip again, cut to at most `frames` frames, and its branches."""
    for clip, whole in read_clips(clips, episodes):
        length = min(frames, len(whole.video))
        episode = cut_episode(whole, 0, length)
        environment.reset(options={"spec": episode.spec})
        free = slice(clip.given - 1, length)
        branches = [
            replace(branch, actions=np.concatenate([episode.actions[: free.start], branch.actions]))
            for branch in plan_branches(
                episode.actions[free],
                donor_actions(clip, whole.actions, episodes)[free],
                environment.still_action(),
                environment.card.action,
            )
        ]
        truths: list[Prediction] = []
        for actions in [episode.actions, *(branch.actions for branch in branches)]:
            made = simulate(environment, episode.spec, actions, frames=length)
            video = as_clip(made.video)
            truth = Prediction.of(made, video, video, environment.card, estimator)
            truths.append(replace(truth, clip=clip, kind="truth"))
        yield branches, replace(truths[0], branches=tuple(truths[1:]))


def perturbed(
    evaluator: Evaluator,
    environment: Environment,
    clips: Sequence[Clip],
    episodes: EpisodeDataset,
) -> tuple[list[Score], Predictability]:
    """Simulate clips again from a slightly different start, and score this as a prediction."""
    scores: list[Score] = []
    errors: list[NDArray[np.float64]] = []
    for clip, episode in read_clips(clips, episodes):
        frames, target = len(episode.video), as_clip(episode.video)
        moved = simulate(environment, episode.spec, episode.actions, frames=frames, perturbation=1)
        made = Prediction.of(
            episode, as_clip(moved.video), target, evaluator.card, evaluator.estimator
        )
        made = replace(made, clip=clip, kind="perturbed")
        scores.append(score(made, evaluator.metrics))
        shown = made.without(clip.given - 1)
        both = (shown.video, shown.target[:1])
        errors.append(np.stack([((each - shown.target) ** 2).mean((1, 2, 3)) for each in both]))
        evaluator.advance(1)
    return scores, predictability(errors)


def predictability(errors: Sequence[NDArray[np.float64]]) -> Predictability:
    """The predictability horizon from each clip's errors `[2, T]`: perturbed, and first frame."""
    share = ratio(*pooled(errors))
    predictable = np.flatnonzero(~(share >= UNPREDICTABLE))
    first = int(predictable[-1]) + 1 if len(predictable) else 0
    horizon = first if first < len(share) else None
    return Predictability(len(errors), [finite(s) for s in share], horizon, UNPREDICTABLE)
