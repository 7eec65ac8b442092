"""Compares masks, outlines and heights in the predicted video with the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from acwm_core.env.physics import Physics
from acwm_core.evaluation.metric import Prediction
from acwm_metrics.physical import (
    MIN_AREA,
    PhysicalMetric,
    counts,
    ids_of,
    physics_of,
    row_means,
    start_of,
    truth_of,
)
from acwm_metrics.seen import last_seen, lost_shapes, measured, seen_of, shown


class MaskIoU(PhysicalMetric):
    """Intersection over union of predicted and true masks, mean over instances.

    The instances are those in either mask, so an instance that vanished counts as 0, and so does
    one that should not be there.
    """

    name = "mask_iou"
    bounds = (0.0, 1.0)
    higher_is_better = True
    group = "States"
    title = "Mask IoU"

    def lacking(self, physics: Physics) -> str | None:
        return None if physics.objects or physics.shapes else "no instances whose masks are read"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """IoU of each frame, `[T]`, in [0, 1]."""
        physics = physics_of(prediction)
        names = dict.fromkeys((*physics.objects, *physics.shapes))
        ids = ids_of(prediction, [*names])
        seen, true = prediction.observed.masks, prediction.masks
        both = counts(np.where(seen == true, seen, 0), ids)
        either = counts(seen, ids) + counts(true, ids) - both
        with np.errstate(invalid="ignore", divide="ignore"):
            return row_means(np.where(either >= MIN_AREA * seen[0].size, both / either, np.nan))


class OutlineError(PhysicalMetric):
    """Distance between predicted and true outlines of things without a pose, such as a rope.

    It is the mean distance in pixels from the points of each outline to the other outline, mean
    over the instances that the true video shows. One that is not found counts with the outline in
    which it was last seen.
    """

    name = "outline_error"
    definition = 2
    unit = "px"
    group = "States"

    def lacking(self, physics: Physics) -> str | None:
        return None if physics.shapes else "nothing that changes its shape"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The distance in each frame, `[T]`, in pixels."""
        names = physics_of(prediction).shapes
        ids, there = ids_of(prediction, names), shown(prediction, names)
        own = seen_of(prediction).masks[:, None] == ids[:, None, None]
        true = prediction.masks[:, None] == ids[:, None, None]
        missing = own.sum((2, 3)) < MIN_AREA * own[0, 0].size
        held = last_seen(own, missing, true[0])
        own = np.where((missing & there)[..., None, None], held, own)
        pairs = zip(own, true, strict=True)
        return row_means(np.array([list(map(_apart, *each)) for each in pairs]))

    def coverage(self, prediction: Prediction, curve: NDArray[np.float64]) -> float:
        """Share of the frames in which all of it is found that the true video shows."""
        return float(1 - lost_shapes(prediction).mean())


class HeightError(PhysicalMetric):
    """Error of the height of sand or water, mean over places.

    For sand, the places are the cells of a height map of the table. For water, it is the height at
    which the water in the container would stand at rest. In frames without the sand or water that
    the true video shows, its last seen height counts.
    """

    name = "height_error"
    definition = 2
    unit = "m"
    group = "States"

    def lacking(self, physics: Physics) -> str | None:
        return None if physics.levels else "no surface whose height is read"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The error in each frame, `[T]`, in m."""
        true, start = truth_of(prediction), start_of(prediction)
        lost, errors = lost_shapes(prediction), list[NDArray[np.float64]]()
        for level in physics_of(prediction).levels:
            seen, right = measured(level, prediction), level.measure(true, start)
            if lost.any():
                missing = np.broadcast_to(lost[:, None], seen.shape)
                seen = np.where(missing, last_seen(seen, missing, right[0]), seen)
            errors.append(np.abs(seen - right))
        return row_means(np.concatenate(errors, axis=1))

    def coverage(self, prediction: Prediction, curve: NDArray[np.float64]) -> float:
        """Share of the frames in which all of it is found that the true video shows."""
        return float(1 - lost_shapes(prediction).mean())


def _apart(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    """The mean distance of two outlines; NaN if either mask is too small."""
    if min(first.sum(), second.sum()) < MIN_AREA * first.size:
        return float("nan")
    a, b = (np.argwhere(mask & ~_inner(mask)) for mask in (first, second))
    there, back = KDTree(b).query(a)[0], KDTree(a).query(b)[0]
    return float(np.concatenate([there, back]).mean())


def _inner(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels inside the mask's edge; pixels at the border of the frame count as edge."""
    return np.asarray(ndimage.binary_erosion(mask), np.bool_)
