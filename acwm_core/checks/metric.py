"""`check_metric`: what evaluation and report rely on in a metric."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.catalog import catalog
from acwm_core.checks.disc import Disc
from acwm_core.checks.result import CheckResult, expect, expect_is_a, factory, run_checks
from acwm_core.checks.trial import EnvironmentTrial
from acwm_core.data.simulate import simulate
from acwm_core.environment import Environment
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
        video = torch.as_tensor(episode.video).permute(0, 3, 1, 2).float() / 255
        return Rollout(
            prediction=video.clone(),
            target=video,
            actions=episode.actions,
            states=episode.states,
            masks=episode.masks,
            contacts=episode.contacts,
            card=trial.card,
        )

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


def check_metric(
    metric: str | Callable[..., Metric],
    environment: str | Callable[..., Environment] | None = None,
    **params: Any,
) -> Iterator[CheckResult]:
    """Check a metric against the contract of `acwm_core.metric.Metric`.

    Args:
        metric: a registered name, or the class.
        environment: what it scores here, a registered name or a class; by default the first
            environment of the metric's own plugin, or a moving disc if that has none.
        **params: constructor parameters.

    Raises:
        UnknownNameError, MissingExtraError, PluginError: a name cannot be resolved.
    """
    make = functools.partial(factory("metric", metric), **params)
    return run_checks(CHECKS, MetricTrial(make, metric, environment or _environment_for(metric)))


def _environment_for(metric: str | Callable[..., Metric]) -> str | type[Environment]:
    plugin = catalog().part("metric", metric).plugin if isinstance(metric, str) else None
    own = [part for part in catalog().registry("environment") if part.plugin == plugin]
    return own[0].name if own else Disc


def scores_a_clip(trial: MetricTrial) -> None:
    """Construct the metric and score a clip, frame by frame and as a whole."""
    metric = trial.metric
    expect_is_a(metric, Metric)
    rollout = trial.noisy(0.1)
    scores = metric.per_frame(rollout)
    frames = len(rollout.target)
    expect(np.shape(scores) == (frames,), f"{frames} frames got {np.shape(scores)} scores")
    expect(np.isfinite(scores).any(), "no frame of a noisy prediction gets a finite score")
    expect(math.isfinite(metric.value(rollout)), "a noisy prediction gets no finite value")


def says_what_it_is(trial: MetricTrial) -> None:
    """Have a name, which is the registered one, a unit and a direction."""
    metric = trial.metric
    if isinstance(trial.subject, str):
        expect(metric.name == trial.subject, f"its name is {metric.name!r}")
    expect(metric.name, "its name is empty")
    for value, base in ((metric.name, str), (metric.unit, str), (metric.higher_is_better, bool)):
        expect_is_a(value, base)


def truth_scores_best(trial: MetricTrial) -> None:
    """Score the true video better than noise and better than the first frame over and over."""
    metric, best = trial.metric, trial.metric.value(trial.perfect)
    expect(not math.isnan(best), "the true video gets no score")
    for name, rollout in (("noise", trial.noisy(0.5)), ("a still first frame", trial.still())):
        value = metric.value(rollout)
        better = best > value if metric.higher_is_better else best < value
        expect(better, f"the true video scores {best:.4g}, {name} scores {value:.4g}")


def more_noise_is_no_better(trial: MetricTrial) -> None:
    """Never improve as the prediction gets noisier."""
    values = [trial.metric.value(trial.noisy(amount)) for amount in (0.0, 0.1, 0.3, 1.0)]
    worse = sorted(values, reverse=trial.metric.higher_is_better)
    listed = ", ".join(f"{value:.4g}" for value in values)
    expect(values == worse, f"with growing noise it goes {listed}")


def scoring_repeats_and_leaves_no_trace(trial: MetricTrial) -> None:
    """Give the same score twice, without a change to what it is given."""
    rollout = trial.noisy(0.1)
    prediction, target = rollout.prediction.clone(), rollout.target.clone()
    states = {name: values.copy() for name, values in rollout.states.items()}
    first, second = (trial.metric.per_frame(rollout) for _ in range(2))
    expect(np.array_equal(first, second, equal_nan=True), "a second scoring differs")
    same = torch.equal(prediction, rollout.prediction) and torch.equal(target, rollout.target)
    expect(same, "it changes the video that it is given")
    for name, values in states.items():
        same = np.array_equal(values, rollout.states[name], equal_nan=True)
        expect(same, f"it changes state {name!r}")


def summary_of_equals_is_their_value(trial: MetricTrial) -> None:
    """Sum up equal values to that value."""
    rollout = trial.noisy(0.1)
    value, weight = trial.metric.value(rollout), trial.metric.weight(rollout)
    summary = trial.metric.summarise([value] * 3, [weight] * 3)
    expect(math.isclose(summary, value, rel_tol=1e-6), f"three times {value:.4g} is {summary:.4g}")


CHECKS = (
    scores_a_clip,
    says_what_it_is,
    truth_scores_best,
    more_noise_is_no_better,
    scoring_repeats_and_leaves_no_trace,
    summary_of_equals_is_their_value,
)
