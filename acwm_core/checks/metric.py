"""`check_metric`: what evaluation and report rely on in a metric."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch

from acwm_core.catalog import catalog
from acwm_core.checks.disc import Disc
from acwm_core.checks.metric_trial import MetricTrial, says_what_it_is
from acwm_core.checks.result import CheckResult, expect, expect_is_a, factory, run_checks
from acwm_core.checks.set_metric import SET_CHECKS
from acwm_core.environment import Environment
from acwm_core.metric import Metric, SetMetric


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
    return run_checks(SET_CHECKS if _compares_sets(metric) else CHECKS, trial)


def _compares_sets(metric: str | Callable[..., Metric]) -> bool:
    made = catalog().component("metric", metric).load() if isinstance(metric, str) else metric
    return isinstance(made, type) and issubclass(made, SetMetric)


def _environment_for(metric: str | Callable[..., Metric]) -> str | type[Environment]:
    plugin = catalog().component("metric", metric).plugin if isinstance(metric, str) else None
    own = [part for part in catalog().registry("environment") if part.plugin == plugin]
    return own[0].name if own else Disc


def scores_a_clip(trial: MetricTrial) -> None:
    """Construct the metric and score a clip, frame by frame and as a whole."""
    metric = trial.metric
    expect_is_a(metric, Metric)
    rollout = trial.noisy(0.1)
    reason = metric.unavailable(rollout.card, rollout.estimator)
    expect(reason is None, f"it cannot be measured here: {reason}")
    scores = metric.per_frame(rollout)
    frames = len(rollout.target)
    expect(np.shape(scores) == (frames,), f"{frames} frames got {np.shape(scores)} scores")
    expect(np.isfinite(scores).any(), "no frame of a noisy prediction gets a finite score")
    expect(math.isfinite(metric.value(rollout)), "a noisy prediction gets no finite value")


def truth_scores_best(trial: MetricTrial) -> None:
    """Score no bad prediction better than the true video, and some worse.

    Which are worse depends on what is measured: a still scene breaks no law of conservation. Where
    a score is not defined there is nothing to compare.
    """
    metric, best = trial.metric, trial.metric.value(trial.perfect)
    expect(not math.isnan(best), "the true video gets no score")
    values = {name: metric.value(rollout) for name, rollout in trial.flawed().items()}
    for name, value in values.items():
        better = _better(trial, value, best)
        expect(not better, f"the true video scores {best:.4g}, {name} scores {value:.4g}")
    sign = -1 if metric.higher_is_better else 1
    worse = any(sign * (value - best) > 0 for value in values.values())
    expect(worse, f"{', '.join(values)}: none scores worse than the true video's {best:.4g}")


def more_noise_is_no_better(trial: MetricTrial) -> None:
    """Never improve as the prediction gets noisier.

    What an estimator makes of noise is open: metrics that need one must only score noise no better
    than the true video.
    """
    metric, amounts = trial.metric, (0.0, 0.1, 0.3, 1.0)
    values = [metric.value(trial.noisy(amount)) for amount in amounts]
    listed = ", ".join(f"{value:.4g}" for value in values)
    if trial.reads_pixels:
        in_order = values == sorted(values, reverse=metric.higher_is_better)
    else:
        in_order = not any(_better(trial, value, values[0]) for value in values)
    expect(in_order, f"with growing noise it goes {listed}")


def _better(trial: MetricTrial, value: float, best: float) -> bool:
    """Whether a bad prediction scores better than the true video.

    What the true video scores by an estimator is the estimator's error, and may be half as large
    for another video.
    """
    if not trial.reads_pixels and not trial.metric.higher_is_better:
        best = best / 2
    return value > best if trial.metric.higher_is_better else value < best


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
