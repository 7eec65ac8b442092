"""Tests that need the simulator: the effect of other actions, and predictability horizons."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.environment import Environment
from acwm_core.errors import AcwmError, DataError
from acwm_core.evaluation.clips import Clip, as_clip, read_clips
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.metric import Metric, Prediction
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.protocol import protocol_named
from acwm_core.evaluation.results import Counterfactual, Ensemble, Predictability, Score
from acwm_core.evaluation.score import build_metrics, score, split_available
from acwm_core.evaluation.statistics import finite
from acwm_core.evaluation.study import Clips
from acwm_core.evaluation.videos import ClipVideo
from acwm_core.model.world_model import CLIP_FRAMES
from acwm_interventions.counterfactual import (
    ROWS,
    counterfactual,
    max_branches,
    pooled,
    ratio,
    simulate_branches,
)
from acwm_interventions.ensemble import compare_ensembles
from acwm_interventions.simulations import Again, simulate_again

COUNTERFACTUAL, PERTURBED, ENSEMBLE = "counterfactual", "perturbed", "ensemble"
"""Names of the tests in `Summary.left_out`."""

TRIED_FRAMES = 8
"""How many frames of an episode the simulator must reproduce."""

UNPREDICTABLE = 0.5
"""From this share on a frame counts as unpredictable: its squared error relative to that of
repeating the first frame. Another episode of the same world has about 2, a perfect copy 0."""


@dataclass(frozen=True)
class Interventions:
    """What the simulator has shown, by split, and why a test or metric was left out, by its name.

    The scores are of the kind ``perturbed``; the videos show branches.
    """

    scores: dict[str, list[Score]] = field(default_factory=dict[str, list[Score]])
    predictability: dict[str, Predictability] = field(default_factory=dict[str, Predictability])
    counterfactual: dict[str, Counterfactual] = field(default_factory=dict[str, Counterfactual])
    ensembles: dict[str, Ensemble] = field(default_factory=dict[str, Ensemble])
    videos: list[ClipVideo] = field(default_factory=list[ClipVideo])
    left_out: dict[str, str] = field(default_factory=dict[str, str])


def simulator_of(episodes: EpisodeDataset, tried: int = 0) -> Environment:
    """The environment that simulated these episodes.

    Args:
        tried: number of the episode that it must reproduce.

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
    first = episodes[tried]
    frames = min(TRIED_FRAMES, len(first.video))
    again = simulate(environment, first.spec, first.actions[:frames], frames=frames)
    if np.abs(again.video - first.video[:frames].astype(float)).mean() > 1:  # beyond rounding
        environment.close()
        raise DataError(
            "the installed simulator does not reproduce the videos of the data: generate the data "
            "again"
        )
    return environment


def asked_clips(config: EvaluationConfig, clips: Clips) -> dict[str, Clips]:
    """The clips of each test, by test and split.

    The counterfactual test takes the first clips that start at their episode's first frame. The
    others take the first clips, but none under a protocol whose clips may start later.
    """
    movable = protocol_named(config.protocol).from_first_frame
    moved = {PERTURBED: config.perturbed_episodes, ENSEMBLE: config.ensemble_episodes}
    return {
        COUNTERFACTUAL: {
            split: [clip for clip in each if clip.start == 0][: config.counterfactual_episodes]
            for split, each in clips.items()
        },
        **{
            test: {split: each[: number * movable] for split, each in clips.items()}
            for test, number in moved.items()
        },
    }


def units_of_work(evaluator: Evaluator, clips: Clips) -> int:
    """Upper bound of the progress that `intervene` reports to `Evaluator.advance`, in rows."""
    branches = len(ROWS) * (1 + max_branches(evaluator.card.action))
    asked = asked_clips(evaluator.config, clips)
    count = {name: sum(map(len, each.values())) for name, each in asked.items()}
    return branches * count[COUNTERFACTUAL] + count[PERTURBED] + count[ENSEMBLE]


def intervene(
    evaluator: Evaluator, clips: Clips, datasets: Mapping[str, EpisodeDataset]
) -> Interventions:
    """Run the tests that need the simulator, if it is available and the config asks for them."""
    config, found = evaluator.config, Interventions()
    metrics = build_metrics(config.counterfactual_metrics, config.metric_options, of_branches=True)
    asked = {n: s for n, s in asked_clips(config, clips).items() if any(s.values())}
    if not metrics:
        asked.pop(COUNTERFACTUAL, None)
    if not asked:
        return found
    try:
        split, first = next((split, each[0]) for split, each in clips.items())
        environment = simulator_of(datasets[split], first.episode)
    except DataError as error:
        found.left_out.update(dict.fromkeys(sorted(asked), str(error)))
        return found
    with contextlib.closing(environment):
        for test, reason in _unavailable(evaluator, environment).items():
            if asked.pop(test, None):
                found.left_out[test] = reason
        if COUNTERFACTUAL in asked:
            metrics, left_out = split_available(metrics, evaluator.card, evaluator.estimator)
            found.left_out.update(left_out)
            _respond(evaluator, environment, metrics, asked[COUNTERFACTUAL], datasets, found)
        for split, few in asked.get(PERTURBED, {}).items():
            found.scores[split], found.predictability[split] = perturbed(
                evaluator, environment, few, datasets[split]
            )
        for split, few in asked.get(ENSEMBLE, {}).items():
            if few:
                found.ensembles[split] = compare_ensembles(
                    evaluator, environment, few, datasets[split]
                )
    return found


def _respond(
    evaluator: Evaluator,
    environment: Environment,
    metrics: Mapping[str, Metric],
    clips: Clips,
    datasets: Mapping[str, EpisodeDataset],
    found: Interventions,
) -> None:
    """Add the responses to other actions, and their videos, to what was found."""
    frames = min(evaluator.world_model.clip_frames, evaluator.given + CLIP_FRAMES - 1)
    for split, few in clips.items():
        if few:
            simulated = simulate_branches(
                environment, few, datasets[split], frames, evaluator.estimator
            )
            found.counterfactual[split], videos = counterfactual(evaluator, metrics, simulated)
            found.videos.extend(videos if evaluator.config.videos else ())


def _unavailable(evaluator: Evaluator, environment: Environment) -> dict[str, str]:
    """Why tests with perturbed starts cannot be run here, by test."""
    name, estimator = evaluator.card.name, evaluator.estimator
    if not environment.can_be_perturbed:
        return dict.fromkeys((PERTURBED, ENSEMBLE), f"{name} has no perturbed start")
    if estimator is None or not estimator.physics.positions:
        why = f"the resolution of a pixel in {name} is unknown, because no positions are read"
        return {ENSEMBLE: why}
    return {}


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
        asked = Again(episode.spec, episode.actions, len(episode.video), perturbation=1)
        (moved,) = simulate_again(environment, [asked])
        truth = Prediction.truth(episode, evaluator.card, evaluator.estimator, clip)
        made = replace(truth, video=as_clip(moved.video), kind="perturbed")
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
