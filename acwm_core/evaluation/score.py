"""`Score`: how well one clip was predicted, in the metrics that the recipe lists."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import PluginError, RecipeError, ShapeError, check_shape, noting
from acwm_core.evaluation.clips import DRAWN, Clip, Predictor
from acwm_core.evaluation.metric import Metric, Prediction, SetMetric
from acwm_core.evaluation.results import Score
from acwm_core.evaluation.views import metric_and_view, parts_of
from acwm_core.plugins import catalog
from acwm_core.recipe.metrics import MetricChoice, MetricConfig, metric_configs


def build_metrics(
    metrics: Iterable[MetricChoice],
    options: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    of_branches: bool = False,
    only: Sequence[str] | None = None,
) -> dict[str, Metric]:
    """Build metrics, by the names that the recipe gives them.

    Args:
        of_branches: whether they must be metrics that compare branches, or must not.
        only: names of those to build, in this order; all by default.
    """
    configs = metric_configs(metrics, options)
    chosen = configs if only is None else [name for name in only if name in configs]
    built = {name: _build(configs[name]) for name in chosen}
    for name, metric in built.items():
        if metric.of_branches != of_branches:
            lists = ("counterfactual_metrics", "metrics")
            wrong, right = lists if of_branches else reversed(lists)
            raise RecipeError(f"{name} belongs in evaluation.{right}, not evaluation.{wrong}")
    return built


def _build(config: MetricConfig) -> Metric:
    metric = config.create()
    if not isinstance(metric, Metric):
        kind = type(metric).__name__
        raise PluginError(f"metric {config.component!r} makes a {kind}, which is not a Metric")
    if config.name not in (metric.name, config.component):
        rest = config.name.removeprefix(f"{metric.name}_")  # ``lpips_vgg`` gives ``LPIPS vgg``
        title, words = metric.info.title, rest.replace("_", " ")
        metric.title = words.capitalize() if rest == config.name else f"{title} {words}"
        metric.name = config.name
    return metric


def split_available(
    metrics: Mapping[str, Metric], card: EnvironmentCard, estimator: StateEstimator | None
) -> tuple[dict[str, Metric], dict[str, str]]:
    """The metrics that can be measured on an environment, and why others cannot, both by name."""
    reasons = {name: metric.unavailable(card, estimator) for name, metric in metrics.items()}
    left_out = {name: str(reason) for name, reason in reasons.items() if reason}
    if len(left_out) == len(metrics):
        raise RecipeError(
            f"none of evaluation.metrics can be measured on {card.name}: "
            + "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        )
    return {name: m for name, m in metrics.items() if name not in left_out}, left_out


def measure_facts(
    metrics: Mapping[str, Metric], estimator: StateEstimator | None
) -> dict[str, Any]:
    """What scores depend on besides the videos: ``metrics`` and ``estimator`` of `provenance`."""
    facts = {name: dict(metric.provenance()) for name, metric in metrics.items()}
    return {
        "metrics": {name: fact for name, fact in facts.items() if fact},
        "estimator": dict(estimator.provenance()) if estimator else None,
    }


def needs_estimator(metric: Metric, card: EnvironmentCard) -> bool:
    """Whether a metric reads states from video, so that errors of its estimator affect it."""
    return metric.reads == "states" and metric.unavailable(card, None) is not None


def headline_of(metrics: Mapping[str, Metric]) -> str:
    """The metric that ranks clips and heads the report: the one of lowest rank, else the first."""
    ranking = [n for n, m in metrics.items() if not (isinstance(m, SetMetric) or m.of_draws)]
    return min(ranking or metrics, key=lambda name: metrics[name].rank)


def quick_metrics(metrics: Mapping[str, Metric], card: EnvironmentCard) -> dict[str, Metric]:
    """The metrics that read no states from video, and always the headline."""
    headline = headline_of(metrics)
    return {n: m for n, m in metrics.items() if n == headline or not needs_estimator(m, card)}


def predictors_for(clip: Clip, predictors: Sequence[Predictor]) -> list[Predictor]:
    """Those of `predictors` that apply to a clip; ``truth`` only if its noise floor is measured."""
    return [predictor for predictor in predictors if predictor != "truth" or clip.noise_floor]


def measured_in(
    predictor: Predictor, clip: Clip, metrics: Mapping[str, Metric], card: EnvironmentCard
) -> dict[str, Metric]:
    """The metrics that are measured for a row of a clip; the others are undefined there.

    A single draw of the model says nothing about its draws, and neither does their mean.
    For ``truth``, metrics that compare pixels say nothing. For ``shuffled``, no states are read:
    this takes longer than the prediction, and the simulator says what other actions should do.
    For ``codec``, they are read where a noise floor is measured.
    """
    if predictor in ("model", *DRAWN):
        return {name: metric for name, metric in metrics.items() if not metric.of_draws}
    if predictor == "truth":
        return {name: m for name, m in metrics.items() if needs_estimator(m, card)}
    if predictor == "shuffled" or (predictor == "codec" and not clip.noise_floor):
        return quick_metrics(metrics, card)
    return dict(metrics)


def score(prediction: Prediction, metrics: Mapping[str, Metric]) -> Score:
    """Score a prediction with the metrics of its row, in float32 and outside any autocast.

    Of the context frames, only the last is scored. Metrics of a view are given that part of the
    frames. A prediction that is not finite gets the worst score in all metrics.
    """
    clip = prediction.clip
    measured = metrics
    if not prediction.draws:
        measured = measured_in(prediction.kind, clip, metrics, prediction.card)
    scored_part = prediction.without(clip.given - 1)
    frames = len(scored_part.target)
    scored = Score(
        split=clip.split,
        episode=clip.episode,
        start=clip.start,
        ood_label=prediction.ood_label,
        kind=prediction.kind,
        frames=frames,
        values=dict.fromkeys(metrics, math.nan),
        weights=dict.fromkeys(metrics, 0.0),
        curves=dict.fromkeys(metrics, [math.nan] * frames),
        failed=not scored_part.is_finite,
    )
    parts = parts_of(scored_part)
    with torch.autocast("cpu", enabled=False):
        for name, metric in measured.items():
            part = scored_part if scored.failed else parts[metric_and_view(name)[1]]
            with noting(f"in metric {name!r} {clip.where}", metric):
                curve = np.full(frames, metric.worst) if scored.failed else metric.curve(part)
                scored.values[name], scored.weights[name] = metric.scored(part, curve)
                scored.curves[name] = curve.astype(np.float32).tolist()
                if metric.reads == "states":
                    seen = 0.0 if scored.failed else metric.coverage(scored_part, curve)
                    scored.shares[name] = float(seen)
                if isinstance(metric, SetMetric) and not scored.failed:
                    features = np.asarray(metric.features(part))
                    check_shape(metric, "features", features, 2, -1)
                    scored.features[name] = features.tolist()
    return scored


def estimator_for(card: EnvironmentCard) -> StateEstimator | None:
    """The estimator that is registered under the card's name; None if there is none.

    Also None if it cannot read data with this card, such as recordings of the same task from
    elsewhere that have no masks.
    """
    if card.name not in catalog().registry("estimator"):
        return None
    try:
        return catalog().component("estimator", card.name).create_as(StateEstimator, card=card)
    except ShapeError:
        return None
