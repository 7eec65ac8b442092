"""`check_metric`: what evaluation and report rely on in a metric."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.catalog import catalog
from acwm_core.checks.disc import Disc, DiscEstimator
from acwm_core.checks.result import CheckResult, expect, expect_is_a, factory, run_checks
from acwm_core.checks.trial import EnvironmentTrial
from acwm_core.data.simulate import simulate
from acwm_core.environment import Environment
from acwm_core.estimator import StateEstimator
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.scoring import estimator_for
from acwm_core.metric import Metric, Reads, Rollout, SetMetric
from acwm_core.shapes import Clip

FRAMES = 24
"""Frames of the clip that is scored."""

CLIPS = 4
"""Clips in a set: the same one, moved sideways by a share of its width each."""


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
    trial = MetricTrial(make, metric, environment or _environment_for(metric))
    made = catalog().component("metric", metric).load() if isinstance(metric, str) else metric
    compares_sets = isinstance(made, type) and issubclass(made, SetMetric)
    return run_checks(SET_CHECKS if compares_sets else CHECKS, trial)


def _environment_for(metric: str | Callable[..., Metric]) -> str | type[Environment]:
    plugin = catalog().component("metric", metric).plugin if isinstance(metric, str) else None
    own = [each for each in catalog().registry("environment") if each.plugin == plugin]
    return own[0].name if own else Disc


class MetricTrial:
    """A metric and a clip of an environment to score, predicted well and badly.

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

    def flawed(self) -> dict[str, Rollout]:
        """Bad predictions of several kinds, by what they show."""
        return {
            "noise": self.noisy(0.5),
            "a still first frame": self.predicted(lambda c: c[:1].expand_as(c).clone()),
            "an empty scene": self.predicted(_emptied),
            "a shifted picture": self.predicted(lambda c: c.roll(c.shape[-1] // 4, -1)),
            "a late video": self.predicted(lambda c: torch.cat([c[:1], c[:1], c[:-2]])),
            "a video that runs backwards": self.predicted(lambda c: c.flip(0)),
        }

    def score(self, rollout: Rollout) -> float:
        """What a clip scores, or a set of clips made of it."""
        if isinstance(self.metric, SetMetric):
            return self.metric.distance(np.stack([*map(self.metric.features, _moved(rollout))]))
        return self.metric.value(rollout)

    def better(self, value: float, best: float) -> bool:
        """Whether a bad prediction scores better than the true video.

        What the true video scores by an estimator is the estimator's error, and may be half as
        large for another video.
        """
        if not self.reads_pixels and not self.metric.higher_is_better:
            best = best / 2
        return value > best if self.metric.higher_is_better else value < best


def _emptied(target: Clip) -> Clip:
    """The first half, then nothing but the colour of the upper left corner."""
    half = len(target) // 2
    return torch.cat([target[:half], target[half:, :, :1, :1].expand_as(target[half:])])


def _moved(rollout: Rollout) -> Iterator[Rollout]:
    """A set of clips that differ, made of one."""
    for place in range(CLIPS):
        shift = rollout.target.shape[-1] * place // CLIPS
        prediction, target = (c.roll(shift, -1) for c in (rollout.prediction, rollout.target))
        yield replace(rollout, prediction=prediction, target=target)


def scores_a_clip(trial: MetricTrial) -> None:
    """Construct the metric and score a clip, frame by frame and as a whole."""
    rollout = _to_be_scored(trial, Metric)
    scores = trial.metric.per_frame(rollout)
    frames = len(rollout.target)
    expect(np.shape(scores) == (frames,), f"{frames} frames got {np.shape(scores)} scores")
    expect(np.isfinite(scores).any(), "no frame of a noisy prediction gets a finite score")
    expect(math.isfinite(trial.score(rollout)), "a noisy prediction gets no finite value")


def scores_a_set(trial: MetricTrial) -> None:
    """Construct the metric, turn clips into vectors and score a set of them."""
    rollout = _to_be_scored(trial, SetMetric)
    shape = np.shape(_raw_scores(trial, rollout))
    expect(len(shape) == 2 and shape[0] == 2, f"features of a clip are {shape}, not (2, D)")
    expect(math.isfinite(trial.score(rollout)), "a noisy set gets no finite score")
    expect(np.isnan(trial.metric.per_frame(rollout)).all(), "a clip has a score of its own")


def _to_be_scored(trial: MetricTrial, base: type) -> Rollout:
    expect_is_a(trial.metric, base)
    rollout = trial.noisy(0.1)
    reason = trial.metric.unavailable(rollout.card, rollout.estimator)
    expect(reason is None, f"it cannot be measured here: {reason}")
    return rollout


def _raw_scores(trial: MetricTrial, rollout: Rollout) -> NDArray[Any]:
    metric = trial.metric
    is_of_sets = isinstance(metric, SetMetric)
    return metric.features(rollout) if is_of_sets else metric.per_frame(rollout)


def says_what_it_is(trial: MetricTrial) -> None:
    """Have a name, which is the registered one, and all that tables need to know."""
    metric = trial.metric
    if isinstance(trial.subject, str):
        expect(metric.name == trial.subject, f"its name is {metric.name!r}")
    expect(metric.name, "its name is empty")
    for text in (metric.name, metric.title, metric.unit, metric.group):
        expect_is_a(text, str)
    expect_is_a(metric.higher_is_better, bool)
    known = get_args(Reads)
    expect(metric.reads in known, f"it reads {metric.reads!r}, which is none of {known}")


def truth_scores_best(trial: MetricTrial) -> None:
    """Score no bad prediction better than the true video, and some worse; equal sets 0.

    Which are worse depends on what is measured: a still scene breaks no law of conservation. Where
    a score is not defined there is nothing to compare.
    """
    best = trial.score(trial.perfect)
    expect(not math.isnan(best), "the true video gets no score")
    values = {name: trial.score(rollout) for name, rollout in trial.flawed().items()}
    for name, value in values.items():
        better = trial.better(value, best)
        expect(not better, f"the true video scores {best:.4g}, {name} scores {value:.4g}")
    sign = -1 if trial.metric.higher_is_better else 1
    worse = any(sign * (value - best) > 0 for value in values.values())
    expect(worse, f"{', '.join(values)}: none scores worse than the true video's {best:.4g}")
    if isinstance(trial.metric, SetMetric):
        expect(best < 1e-3 * values["noise"], f"equal sets score {best:.4g}, not 0")


def more_noise_is_no_better(trial: MetricTrial) -> None:
    """Never improve as the prediction gets noisier.

    What an estimator makes of noise is open: metrics that need one must only score noise no better
    than the true video.
    """
    values = [trial.score(trial.noisy(amount)) for amount in (0.0, 0.1, 0.3, 1.0)]
    listed = ", ".join(f"{value:.4g}" for value in values)
    if trial.reads_pixels:
        in_order = values == sorted(values, reverse=trial.metric.higher_is_better)
    else:
        in_order = not any(trial.better(value, values[0]) for value in values)
    expect(in_order, f"with growing noise it goes {listed}")


def scoring_repeats_and_leaves_no_trace(trial: MetricTrial) -> None:
    """Give the same scores twice, without a change to what it is given."""
    rollout = trial.noisy(0.1)
    prediction, target = rollout.prediction.clone(), rollout.target.clone()
    states = {name: values.copy() for name, values in rollout.states.items()}
    first, second = (_raw_scores(trial, rollout) for _ in range(2))
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


SHARED_CHECKS = (
    says_what_it_is,
    truth_scores_best,
    more_noise_is_no_better,
    scoring_repeats_and_leaves_no_trace,
)
CHECKS = (scores_a_clip, *SHARED_CHECKS, summary_of_equals_is_their_value)
SET_CHECKS = (scores_a_set, *SHARED_CHECKS)
