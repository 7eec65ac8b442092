"""Metrics of each view, where a frame shows several cameras side by side.

``psnr@wrist`` is the metric ``psnr`` on that part of a frame which shows the camera ``wrist``.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import replace

from acwm_core.env.card import EnvironmentCard
from acwm_core.evaluation.metric import Metric, Prediction, SetMetric

AT = "@"
"""Between the name of a metric and that of a view; no metric has it in its own name."""


def metric_and_view(name: str) -> tuple[str, str]:
    """The name of a metric without its view, and the view; ``""`` stands for the whole frame."""
    metric, _, view = name.partition(AT)
    return metric, view


def of_view(metric: str, view: str) -> str:
    """The inverse of `metric_and_view`."""
    return f"{metric}{AT}{view}" if view else metric


def metrics_of_views(
    metrics: Mapping[str, Metric], card: EnvironmentCard
) -> tuple[dict[str, Metric], dict[str, str]]:
    """Metrics of pixels once more for each view, and why some cannot be measured, both by name.

    Distances between sets of clips are left to the whole frame.
    """
    of_views: dict[str, Metric] = {}
    left_out: dict[str, str] = {}
    own = _card_of_a_view(card) if card.views else card
    for view in card.view_names:
        for name, metric in metrics.items():
            if metric.reads != "pixels" or isinstance(metric, SetMetric):
                continue
            reason = metric.unavailable(own, None)
            if reason:
                left_out[of_view(name, view)] = reason
            else:
                of_views[of_view(name, view)] = _renamed(metric, view)
    return of_views, left_out


def parts_of(prediction: Prediction) -> dict[str, Prediction]:
    """The prediction under the view ``""``, and what each view of its card shows of it."""
    card = prediction.card
    parts = {"": prediction}
    if not card.views:
        return parts
    own = _card_of_a_view(card)
    width = own.frame_size[1]
    for place, view in enumerate(card.view_names):
        columns = slice(place * width, (place + 1) * width)
        parts[view] = replace(
            prediction,
            video=prediction.video[..., columns],
            target=prediction.target[..., columns],
            masks=prediction.masks[..., columns],
            card=own,
            draws=tuple(parts_of(draw)[view] for draw in prediction.draws),
        )
    return parts


def _card_of_a_view(card: EnvironmentCard) -> EnvironmentCard:
    height, width = card.frame_size
    return replace(card, frame_size=(height, width // len(card.views)), views=())


def _renamed(metric: Metric, view: str) -> Metric:
    """The same metric under the name of a view; it shares networks with the other."""
    of_own = copy.copy(metric)
    of_own.name, of_own.title = of_view(metric.name, view), f"{metric.info.title} {view}"
    return of_own
