"""Measures the model's errors, with states that the world's estimator reads from its frames."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import StateEstimator
from acwm_core.errors import sentence
from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.metric import Metric, Prediction
from acwm_core.plugins import catalog
from acwm_play.simulator import TimeStep

METRICS = ("position_error", "height_error", "mask_iou")
"""Metrics to measure, if they are installed and available for the world."""

MISSING_BELOW = 0.2
"""Share of its true area below which an object counts as missing, as in metric `permanence`."""

MIN_PIXELS = 4
"""Smallest area of an object in the simulator's frame, in pixels; smaller ones are ignored."""


class Figures(NamedTuple):
    """Measurements of a frame.

    Attributes:
        values: score by name of the metric; None where it is not defined.
        floors: the same scores for the simulator's own frame, which show the error of the
            measurement itself; empty unless requested.
        missing: names of objects that the simulator shows and the model does not.
    """

    values: dict[str, float | None]
    floors: dict[str, float | None]
    missing: list[str]


class Instruments:
    """The estimator of a world and the metrics that can be measured with it.

    Args:
        card: card of the environment, with the frame size.

    Attributes:
        about: title and unit of each metric by its name; empty if nothing can be measured.
        why_not: the reason why nothing can be measured, or None.
    """

    def __init__(self, card: EnvironmentCard) -> None:
        self._card = card
        self._estimator: StateEstimator | None = None
        self.why_not: str | None = None
        try:
            component = catalog().component("estimator", card.name)
            self._estimator = component.create_as(StateEstimator, card=card)
        except Exception as error:  # whatever a plugin raises
            self.why_not = sentence(error)
        known = catalog().registry("metric")
        metrics = {name: known[name].create_as(Metric) for name in METRICS if name in known}
        usable = self._estimator is not None
        self._metrics = {
            name: metric
            for name, metric in metrics.items()
            if usable and metric.unavailable(card, self._estimator) is None
        }
        self.about = {
            name: {"title": metric.info.title, "unit": metric.unit}
            for name, metric in self._metrics.items()
        }

    def measure(self, frame: NDArray[np.uint8], truth: TimeStep, floor: bool = False) -> Figures:
        """Compare a frame `[H, W, 3]` from the model with the simulator's truth."""
        prediction = self._prediction(frame, truth)
        floors = self._scores(self._prediction(truth.frame, truth)) if floor else {}
        return Figures(self._scores(prediction), floors, self._missing(prediction))

    def _prediction(self, frame: NDArray[np.uint8], truth: TimeStep) -> Prediction:
        pictures = as_clip(np.stack([frame, truth.frame]))
        return Prediction(
            video=pictures[:1],
            target=pictures[1:],
            actions=np.zeros((1, self._card.action.size), np.float32),
            states={name: value[None] for name, value in truth.state.items()},
            masks=truth.mask[None],
            contacts=np.zeros((0, 3), np.int32),
            card=self._card,
            estimator=self._estimator,
        )

    def _scores(self, prediction: Prediction) -> dict[str, float | None]:
        values = {name: metric.scored(prediction)[0] for name, metric in self._metrics.items()}
        return {name: v if math.isfinite(v) else None for name, v in values.items()}

    def _missing(self, prediction: Prediction) -> list[str]:
        if self._estimator is None:
            return []
        missing: list[str] = []
        for name in self._estimator.physics.objects:
            number = self._card.instances.index(name)
            area = int((prediction.masks == number).sum())
            predicted_area = int((prediction.observed.masks == number).sum())
            if area >= MIN_PIXELS and predicted_area < MISSING_BELOW * area:
                missing.append(name)
        return missing


def pixel_error(frame: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    """Root mean square difference of two frames, as a share of full scale."""
    difference: Any = frame.astype(np.float32) - truth.astype(np.float32)
    return float(np.sqrt(np.mean(difference**2))) / 255
