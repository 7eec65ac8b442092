"""Scores of predicted clips by the metrics of the catalog."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.catalog import catalog
from acwm_core.environment import EnvironmentCard
from acwm_core.errors import PluginError
from acwm_core.evaluation.protocol import Kind, Sample
from acwm_core.evaluation.results import ClipResult
from acwm_core.metric import Metric, Rollout
from acwm_core.shapes import Clip


def build_metrics(names: Sequence[str]) -> dict[str, Metric]:
    """Metrics by their registered names.

    Raises:
        UnknownNameError, MissingExtraError: a metric cannot be had.
        PluginError: what is registered under a name is no `Metric`.
    """
    metrics: dict[str, Metric] = {}
    for name in names:
        metric: Any = catalog().create("metric", name)
        if not isinstance(metric, Metric):
            made = type(metric).__name__
            raise PluginError(f"metric {name!r} makes a {made}, which is no Metric")
        metrics[name] = metric
    return metrics


def rollout_of(sample: Sample, prediction: Clip, card: EnvironmentCard) -> Rollout:
    """What metrics see of a predicted clip `[T, 3, H, W]`."""
    episode, frames = sample.episode, len(sample.video)
    contacts = episode.contacts
    return Rollout(
        prediction=prediction,
        target=sample.video,
        actions=sample.actions,
        states={name: values[:frames] for name, values in episode.states.items()},
        masks=episode.masks[:frames],
        contacts=contacts[contacts[:, 0] < frames],
        card=card,
    )


@dataclass(frozen=True)
class Prediction:
    """One row's prediction `[T, 3, H, W]` of a clip, float32 on the CPU."""

    sample: Sample
    kind: Kind
    video: Clip


def score(
    prediction: Prediction, metrics: Mapping[str, Metric], card: EnvironmentCard
) -> ClipResult:
    """Score one prediction, in float32 and outside any autocast."""
    sample = prediction.sample
    rollout = rollout_of(sample, prediction.video, card)
    with torch.autocast("cpu", enabled=False):
        curves = {name: metric.per_frame(rollout) for name, metric in metrics.items()}
        values = {name: _value(m, rollout, curves[name]) for name, m in metrics.items()}
        weights = {name: metric.weight(rollout) for name, metric in metrics.items()}
    return ClipResult(
        sample.plan.split,
        sample.plan.episode,
        sample.episode.ood_label,
        prediction.kind,
        len(sample.video),
        values,
        weights,
        {name: curve.tolist() for name, curve in curves.items()},
    )


def _value(metric: Metric, rollout: Rollout, curve: NDArray[np.float64]) -> float:
    """The clip's score; the default is the mean of a curve that need not be computed twice."""
    if type(metric).value is Metric.value:
        return float(np.nanmean(curve))
    return metric.value(rollout)
