"""Scores of predicted clips by the metrics of the catalog."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import PluginError, RecipeError, ShapeError, check_shape, noting
from acwm_core.evaluation.clip_results import ClipResult
from acwm_core.evaluation.clips import ClipPlan, Predictor, Sample
from acwm_core.evaluation.metric import Metric, Rollout, SetMetric
from acwm_core.model.shapes import Clip
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

    Raises:
        RecipeError: a metric compares branches but must not, or the reverse; a name is used twice.
        UnknownNameError, MissingExtraError: a metric is not available.
        PluginError: what is registered under a name is no `Metric`.
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
        made = type(metric).__name__
        raise PluginError(f"metric {config.component!r} makes a {made}, which is not a Metric")
    texts = (metric.name, metric.title, metric.unit, metric.group)
    if not all(isinstance(cast(object, each), str) for each in texts):
        raise PluginError(
            f"name, title, unit and group of metric {config.component!r} must be text"
        )
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
        "metrics": {name: each for name, each in facts.items() if each},
        "estimator": dict(estimator.provenance()) if estimator else None,
    }


def needs_estimator(metric: Metric, card: EnvironmentCard) -> bool:
    """Whether a metric reads states from video, so that errors of its estimator affect it."""
    return metric.reads == "states" and metric.unavailable(card, None) is not None


def headline_of(metrics: Mapping[str, Metric]) -> str:
    """The metric that ranks clips and heads the report: the one of lowest rank, else the first."""
    ranking = [name for name, metric in metrics.items() if not isinstance(metric, SetMetric)]
    return min(ranking or metrics, key=lambda name: metrics[name].rank)


def quick_metrics(metrics: Mapping[str, Metric], card: EnvironmentCard) -> dict[str, Metric]:
    """The metrics that read no states from video, and always the headline."""
    headline = headline_of(metrics)
    return {n: m for n, m in metrics.items() if n == headline or not needs_estimator(m, card)}


def predictors_for(plan: ClipPlan, predictors: Sequence[Predictor]) -> list[Predictor]:
    """Those of `predictors` that apply to a clip; ``truth`` only if its noise floor is measured."""
    return [each for each in predictors if each != "truth" or plan.noise_floor]


def measured_in(
    predictor: Predictor, plan: ClipPlan, metrics: Mapping[str, Metric], card: EnvironmentCard
) -> dict[str, Metric]:
    """The metrics that are measured for a row of a clip; the others are undefined there.

    For ``truth``, metrics that compare pixels say nothing. For ``shuffled``, no states are read:
    this takes longer than the prediction, and the simulator says what other actions should do.
    For ``codec``, they are read where a noise floor is measured.
    """
    if predictor == "truth":
        return {name: m for name, m in metrics.items() if needs_estimator(m, card)}
    if predictor == "shuffled" or (predictor == "codec" and not plan.noise_floor):
        return quick_metrics(metrics, card)
    return dict(metrics)


@dataclass(frozen=True)
class Prediction:
    """One row's predicted video of a clip, `[T, 3, H, W]`, float32 on the CPU."""

    sample: Sample
    predictor: Predictor
    video: Clip


def score(
    prediction: Prediction,
    metrics: Mapping[str, Metric],
    card: EnvironmentCard,
    estimator: StateEstimator | None = None,
) -> ClipResult:
    """Score one prediction with the metrics of its row, in float32 and outside any autocast.

    A prediction that is not finite gets the worst score in all of them.
    """
    sample = prediction.sample
    measured = measured_in(prediction.predictor, sample.plan, metrics, card)
    scored = sample.plan.scored(sample.episode, sample.video, prediction.video)
    rollout = Rollout.of(*scored, card, estimator)
    if not rollout.is_finite:
        return _failed(prediction, rollout, measured, metrics)
    curves, scores, sets = (
        dict[str, NDArray[np.float64]](),
        dict[str, tuple[float, float]](),
        dict[str, Any](),
    )
    with torch.autocast("cpu", enabled=False):
        for name, metric in measured.items():
            with noting(f"in metric {name!r} {sample.plan.where}", metric):
                curves[name] = metric.curve(rollout)
                scores[name] = metric.scored(rollout, curves[name])
                if isinstance(metric, SetMetric):
                    sets[name] = np.asarray(metric.features(rollout))
                    check_shape(metric, "features", sets[name], 2, -1)
    values, weights = ({n: s[place] for n, s in scores.items()} for place in (0, 1))
    undefined = [name for name in metrics if name not in measured]
    curves |= dict.fromkeys(undefined, np.full(len(rollout.target), np.nan))
    values |= dict.fromkeys(undefined, float("nan"))
    weights |= dict.fromkeys(undefined, 0.0)
    return ClipResult(
        **_place(prediction, rollout),
        values=values,
        weights=weights,
        curves={name: curve.astype(np.float32).tolist() for name, curve in curves.items()},
        features={name: each.tolist() for name, each in sets.items()},
    )


def _failed(
    prediction: Prediction,
    rollout: Rollout,
    measured: Mapping[str, Metric],
    metrics: Mapping[str, Metric],
) -> ClipResult:
    """The result of a prediction that is not finite: the worst score in every metric of its row."""
    values = {n: m.worst if n in measured else float("nan") for n, m in metrics.items()}
    frames = len(rollout.target)
    return ClipResult(
        **_place(prediction, rollout),
        values=values,
        weights={name: float(name in measured) for name in metrics},
        curves={name: [value] * frames for name, value in values.items()},
        failed=True,
    )


def _place(prediction: Prediction, rollout: Rollout) -> dict[str, Any]:
    sample = prediction.sample
    return {
        "split": sample.plan.split,
        "episode": sample.plan.episode,
        "start": sample.plan.start,
        "ood_label": sample.episode.ood_label,
        "kind": prediction.predictor,
        "frames": len(rollout.target),
    }


def estimator_for(card: EnvironmentCard) -> StateEstimator | None:
    """The estimator that is registered under the card's name; None if there is none.

    Also None if it cannot read data with this card, such as recordings of the same task from
    elsewhere that have no masks.

    Raises:
        PluginError: what is registered is no `StateEstimator`.
        MissingExtraError, DataError: it is not available, or its weights cannot be read.
    """
    if card.name not in catalog().registry("estimator"):
        return None
    try:
        return catalog().component("estimator", card.name).create_as(StateEstimator, card=card)
    except ShapeError:
        return None
