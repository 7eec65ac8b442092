"""What a metric is tried on: a clip of an environment, predicted well and badly."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.checks.disc import Disc
from acwm_core.checks.disc_estimator import DiscEstimator
from acwm_core.checks.result import expect, expect_is_a, factory
from acwm_core.checks.trial import EnvironmentTrial
from acwm_core.data.simulate import simulate
from acwm_core.environment import Environment
from acwm_core.estimator import StateEstimator
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.scoring import estimator_for
from acwm_core.metric import Metric, Rollout
from acwm_core.shapes import Clip

FRAMES = 24
"""Frames of the clip that is scored."""


class MetricTrial:
    """A metric and a clip of an environment to score.

    Args:
        make: constructs the metric.
        subject: what the user asked to check.
        environment: an environment whose episodes it can score, a name or a class.
    """

    def __init__(
        self,
        make: Callable[..., Metric],
        subject: object,
        environment: str | Callable[..., Environment],
    ) -> None:
        self.make = make
        self.subject = subject
        self.environment = EnvironmentTrial(factory("environment", environment), environment)

    @functools.cached_property
    def metric(self) -> Metric:
        """One instance."""
        return self.make()

    @property
    def reads_pixels(self) -> bool:
        """Whether the metric can do without an estimator."""
        return self.metric.unavailable(self.environment.card, None) is None

    @functools.cached_property
    def perfect(self) -> Rollout:
        """The first frames of an episode and of a branch of it, predicted without error."""
        actions = self.environment.episode.actions[:FRAMES]
        backwards = np.concatenate([actions[-2::-1], actions[-1:]])
        clip, branch = (self._simulated(rows) for rows in (actions, backwards))
        return replace(clip, branches=(branch,))

    def _simulated(self, actions: NDArray[np.float32]) -> Rollout:
        """What comes of these actions `[T, A]`, predicted without error."""
        trial = self.environment
        episode = simulate(trial.environment, trial.spec(), actions, frames=len(actions))
        video = as_clip(episode.video)
        return Rollout.of(episode, video, video.clone(), trial.card, self.estimator)

    @functools.cached_property
    def estimator(self) -> StateEstimator | None:
        """What reads the environment's video."""
        card = self.environment.card
        return DiscEstimator(card) if card.name == Disc.card.name else estimator_for(card)

    def predicted(self, predict: Callable[[Clip], Clip]) -> Rollout:
        """The same clip and branch with other predictions, made of the truth."""
        clip, branches = self.perfect, self.perfect.branches
        others = (replace(each, prediction=predict(each.target)) for each in branches)
        return replace(clip, prediction=predict(clip.target), branches=tuple(others))

    def noisy(self, amount: float) -> Rollout:
        """The first frames kept and so much Gaussian noise on the others."""
        generator = torch.Generator().manual_seed(0)

        def predict(target: Clip) -> Clip:
            noise = torch.randn(target.shape, generator=generator) * amount
            noise[0] = 0
            return (target + noise).clamp(0, 1)

        return self.predicted(predict)

    def still(self) -> Rollout:
        """The first frame over and over."""
        return self.predicted(lambda target: target[:1].expand_as(target).clone())

    def flawed(self) -> dict[str, Rollout]:
        """Bad predictions of several kinds, by what they show."""
        return {
            "noise": self.noisy(0.5),
            "a still first frame": self.still(),
            "an empty scene": self.predicted(_emptied),
            "a shifted picture": self.predicted(_shifted),
            "a late video": self.predicted(_late),
            "a video that runs backwards": self.predicted(lambda target: target.flip(0)),
        }


def _emptied(target: Clip) -> Clip:
    """The first half, then nothing but the colour of the upper left corner."""
    half = len(target) // 2
    return torch.cat([target[:half], target[half:, :, :1, :1].expand_as(target[half:])])


def _shifted(target: Clip) -> Clip:
    """All to the right by a quarter of the frame."""
    return target.roll(target.shape[-1] // 4, -1)


def _late(target: Clip) -> Clip:
    """Two frames behind."""
    return torch.cat([target[:1], target[:1], target[:-2]])


def says_what_it_is(trial: MetricTrial) -> None:
    """Have a name, which is the registered one, a unit and a direction."""
    metric = trial.metric
    if isinstance(trial.subject, str):
        expect(metric.name == trial.subject, f"its name is {metric.name!r}")
    expect(metric.name, "its name is empty")
    for value, base in ((metric.name, str), (metric.unit, str), (metric.higher_is_better, bool)):
        expect_is_a(value, base)
