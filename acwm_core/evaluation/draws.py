"""Scores of several draws of one clip, whatever made them: one by one, their mean, and the best."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from acwm_core.errors import RecipeError
from acwm_core.evaluation.clips import DRAWN
from acwm_core.evaluation.metric import Metric, Prediction, mean_of_defined
from acwm_core.evaluation.results import Score
from acwm_core.evaluation.score import score

Metrics = Mapping[str, Metric]


def score_draws(draws: Sequence[Prediction], metrics: Metrics) -> list[Score]:
    """Score the draws of one clip: the row of their kind, and one of each kind in `DRAWN`.

    The first row has the mean score of a draw, summed up in each metric's own way, and the scores
    of metrics that judge the draws together. The others have the scores of the mean frames, and of
    the draw that is best in each metric. A single draw is scored once, and is its own mean and
    best. Distances between sets of clips take the first draw, and have no best one.

    Args:
        draws: predictions of the same clip, at least one, without draws of their own. They may come
            from anywhere.
        metrics: by name.
    """
    seen = [draw.without(draw.clip.given - 1) for draw in draws]
    seen = [replace(draw, clip=replace(draw.clip, given=1)) for draw in seen]
    scores = [score(draw, metrics) for draw in seen]
    judges = {name: metric for name, metric in metrics.items() if metric.of_draws}
    together = score(replace(seen[0], draws=tuple(seen)), judges)
    one, mean = mean_score(scores, metrics), scores[0]
    if len(seen) > 1:
        video = torch.stack([draw.video for draw in seen]).mean(0)
        mean = score(replace(seen[0], video=video), metrics)
    one = replace(
        one,
        values={**one.values, **together.values},
        weights={**one.weights, **together.weights},
        curves={**one.curves, **together.curves},
        shares={**one.shares, **together.shares},
    )
    kinds, rows = (draws[0].kind, *DRAWN), (one, mean, best_score(scores, metrics))
    return [replace(row, kind=kind) for row, kind in zip(rows, kinds, strict=True)]


def mean_score(scores: Sequence[Score], metrics: Metrics) -> Score:
    """The mean score of draws; where a metric sums clips up in its own way, draws likewise."""
    first = scores[0]
    if len(scores) == 1:
        return first
    weights = {name: np.array([score.weights[name] for score in scores]) for name in metrics}
    values = {name: np.array([score.values[name] for score in scores]) for name in metrics}
    curves = {name: np.array([score.curves[name] for score in scores]) for name in metrics}
    shares = {name: np.array([score.shares[name] for score in scores]) for name in first.shares}
    return replace(
        first,
        values={name: _summed_up(m, values[name], weights[name]) for name, m in metrics.items()},
        weights={name: float(clip_weights.mean()) for name, clip_weights in weights.items()},
        curves={
            name: [_summed_up(metric, frame, weights[name]) for frame in curves[name].T]
            for name, metric in metrics.items()
        },
        shares={name: mean_of_defined(clip_shares) for name, clip_shares in shares.items()},
        failed=any(score.failed for score in scores),
    )


def _summed_up(metric: Metric, values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    held = ~np.isnan(values) & (weights > 0)
    return metric.summed_up(values[held], weights[held]) if held.any() else math.nan


def best_score(scores: Sequence[Score], metrics: Metrics) -> Score:
    """The score of the best draw, chosen for each metric by itself."""
    chosen = {name: scores[_best(scores, name, metric)] for name, metric in metrics.items()}
    return replace(
        scores[0],
        values={name: score.values[name] for name, score in chosen.items()},
        weights={name: score.weights[name] for name, score in chosen.items()},
        curves={name: score.curves[name] for name, score in chosen.items()},
        shares={name: score.shares[name] for name, score in chosen.items() if name in score.shares},
        features=scores[0].features if len(scores) == 1 else {},
        failed=all(score.failed for score in scores),
    )


def _best(scores: Sequence[Score], name: str, metric: Metric) -> int:
    sign = -1 if metric.higher_is_better else 1
    values = np.array([sign * score.values[name] for score in scores])
    return 0 if np.isnan(values).all() else int(np.nanargmin(values))


def metrics_for(metrics: Mapping[str, Metric], samples: int) -> dict[str, Metric]:
    """The metrics that are measured with so many draws of a clip.

    Raises:
        RecipeError: all of them judge draws together, so that none can rank clips.
    """
    of_one = {name: metric for name, metric in metrics.items() if not metric.of_draws}
    if metrics and not of_one:
        raise RecipeError(
            f"{', '.join(metrics)} judge several draws of a clip together: add a metric of "
            "single draws to evaluation.metrics"
        )
    return dict(metrics) if samples > 1 else of_one
