"""What evaluation and report rely on in a metric that compares sets of clips."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch

from acwm_core.checks.metric_trial import MetricTrial, says_what_it_is
from acwm_core.checks.result import expect, expect_is_a
from acwm_core.metric import Rollout, SetMetric

CLIPS = 4
"""In a set: the same clip, moved sideways by a share of its width each."""


def moved(rollout: Rollout) -> list[Rollout]:
    """A set of clips that differ, made of one."""
    width = rollout.target.shape[-1]
    return [
        replace(
            rollout,
            prediction=rollout.prediction.roll(width * place // CLIPS, -1),
            target=rollout.target.roll(width * place // CLIPS, -1),
        )
        for place in range(CLIPS)
    ]


def distance(trial: MetricTrial, rollout: Rollout) -> float:
    """What a set of clips like `rollout` scores."""
    metric = trial.metric
    assert isinstance(metric, SetMetric)
    return metric.distance(np.stack([metric.features(each) for each in moved(rollout)]))


def scores_a_set(trial: MetricTrial) -> None:
    """Construct the metric, turn clips into vectors and score a set of them."""
    metric = trial.metric
    expect_is_a(metric, SetMetric)
    assert isinstance(metric, SetMetric)
    rollout = trial.noisy(0.1)
    reason = metric.unavailable(rollout.card, rollout.estimator)
    expect(reason is None, f"it cannot be measured here: {reason}")
    shape = np.shape(metric.features(rollout))
    expect(len(shape) == 2 and shape[0] == 2, f"features of a clip are {shape}, not (2, D)")
    expect(math.isfinite(distance(trial, rollout)), "a noisy set gets no finite score")
    alone = metric.per_frame(rollout)
    expect(np.isnan(alone).all(), "a clip has a score of its own")


def truth_scores_best(trial: MetricTrial) -> None:
    """Score the true videos 0, and better than noise and than first frames over and over."""
    best = distance(trial, trial.perfect)
    noisy, still = distance(trial, trial.noisy(0.5)), distance(trial, trial.still())
    expect(best < 1e-3 * noisy, f"the true videos score {best:.4g}, noise scores {noisy:.4g}")
    expect(best < still, f"the true videos score {best:.4g}, still ones score {still:.4g}")


def more_noise_is_no_better(trial: MetricTrial) -> None:
    """Never improve as the predictions get noisier."""
    values = [distance(trial, trial.noisy(amount)) for amount in (0.0, 0.1, 0.3, 1.0)]
    listed = ", ".join(f"{value:.4g}" for value in values)
    expect(values == sorted(values), f"with growing noise it goes {listed}")


def scoring_repeats_and_leaves_no_trace(trial: MetricTrial) -> None:
    """Give the same vectors twice, without a change to the video."""
    metric, rollout = trial.metric, trial.noisy(0.1)
    assert isinstance(metric, SetMetric)
    prediction, target = rollout.prediction.clone(), rollout.target.clone()
    first, second = (metric.features(rollout) for _ in range(2))
    expect(np.array_equal(first, second), "a second scoring differs")
    same = torch.equal(prediction, rollout.prediction) and torch.equal(target, rollout.target)
    expect(same, "it changes the video that it is given")


SET_CHECKS = (
    scores_a_set,
    says_what_it_is,
    truth_scores_best,
    more_noise_is_no_better,
    scoring_repeats_and_leaves_no_trace,
)
