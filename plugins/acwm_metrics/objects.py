"""Metrics of objects: how many there are, in which colours, and whether they survive contacts."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.physics import Physics
from acwm_core.evaluation.metric import Prediction
from acwm_metrics.conservation import Permanence
from acwm_metrics.contact import first_contact
from acwm_metrics.physical import MIN_AREA, PhysicalMetric, counts, ids_of, physics_of, row_means
from acwm_metrics.presence import parts_of
from acwm_metrics.seen import mean_colour, seen_of


class PermanenceAfterContact(Permanence):
    """`permanence` from the first true contact on: do objects survive that they are touched?

    Frames before the first contact, and episodes without any, have no score.
    """

    name = "permanence_after_contact"
    definition = 1

    def lacking(self, physics: Physics) -> str | None:
        told = any(gap.touch is not None for gap in physics.gaps)
        return super().lacking(physics) or (None if told else "no contacts that can be detected")

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """1 for a frame in which every object is there once, else 0, `[T]`."""
        once = super().per_frame(prediction)
        return np.where(np.arange(len(once)) >= first_contact(prediction), once, np.nan)


class ObjectCountError(PhysicalMetric):
    """How many objects are too many or too few, compared with those that the true video shows.

    Every part of an object in several parts counts. One that is missing and one that is made up are
    two errors.
    """

    name = "object_count_error"

    def lacking(self, physics: Physics) -> str | None:
        return None if physics.objects else "no objects to count"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The number of objects too many or too few in each frame, `[T]`."""
        seen, true = (
            parts_of(prediction, masks) for masks in (seen_of(prediction).masks, prediction.masks)
        )
        return np.abs(seen - true).sum(1).astype(np.float64)


class ColourError(PhysicalMetric):
    """Difference of the mean colours of objects, wherever they are, from their true ones.

    It is the root mean square over channels of values in [0, 1], mean over the objects that the
    true video shows. An object that is not found counts as 1, the difference of black and white.
    """

    name = "colour_error"
    bounds = (0.0, 1.0)
    group = "States"

    def lacking(self, physics: Physics) -> str | None:
        return None if physics.objects or physics.shapes else "no objects with a colour"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The difference in each frame, `[T]`, in [0, 1]."""
        return row_means(self._errors(prediction))

    def coverage(self, prediction: Prediction, curve: NDArray[np.float64]) -> float:
        """Share of the objects and frames that are found."""
        errors = self._errors(prediction)
        known = ~np.isnan(errors)
        return float((errors[known] < 1).mean()) if known.any() else math.nan

    def _errors(self, prediction: Prediction) -> NDArray[np.float64]:
        """The difference of each object, `[T, n]`; NaN where the true video does not show it."""
        return prediction.once(ColourError, lambda: _colour_errors(prediction))


def _colour_errors(prediction: Prediction) -> NDArray[np.float64]:
    physics = physics_of(prediction)
    ids = ids_of(prediction, [*dict.fromkeys((*physics.objects, *physics.shapes))])
    pairs = (prediction.video, seen_of(prediction).masks), (prediction.target, prediction.masks)
    seen, true = (
        np.stack([mean_colour(video.numpy(), masks == each) for each in ids], 1)
        for video, masks in pairs
    )
    errors = np.sqrt(((seen - true) ** 2).mean(-1))
    there = counts(prediction.masks, ids) >= MIN_AREA * prediction.masks[0].size
    return np.where(there, np.where(np.isnan(errors), 1.0, errors), np.nan)
