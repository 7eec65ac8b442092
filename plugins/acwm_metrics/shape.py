"""How well the predicted video covers what the true one shows: masks and outlines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from acwm_core.estimator import Physics
from acwm_core.metric import Rollout
from acwm_metrics.physical import (
    PhysicalMetric,
    instance_id,
    measured,
    physics_of,
    row_means,
    start_of,
    truth_of,
)

MIN_AREA = 5e-4
"""Share of the frame below which nothing can be said of an instance: 2 pixels of 64 × 64."""


class MaskIoU(PhysicalMetric):
    """Overlap of predicted and true masks: intersection over union, mean over instances.

    The instances are those that either mask shows, so one that vanished counts with 0, and so does
    one that should not be there.
    """

    name = "mask_iou"
    higher_is_better = True
    group = "States"
    title = "Mask IoU"

    def lacking(self, physics: Physics) -> str | None:
        """Masks."""
        return None if physics.objects or physics.shapes else "no instances whose masks are read"

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`, in [0, 1]."""
        physics = physics_of(rollout)
        names = dict.fromkeys((*physics.objects, *physics.shapes))
        ids = np.array([instance_id(rollout, name) for name in names])
        seen, true = rollout.observed.masks, rollout.masks
        both = counts(np.where(seen == true, seen, 0), ids)
        either = counts(seen, ids) + counts(true, ids) - both
        with np.errstate(invalid="ignore", divide="ignore"):
            return row_means(np.where(either >= MIN_AREA * seen[0].size, both / either, np.nan))


class OutlineError(PhysicalMetric):
    """How far the outline of what has no pose, such as a rope, lies from the true outline.

    The mean distance in pixels from points of either outline to the other, mean over the instances
    that both show.
    """

    name = "outline_error"
    unit = "px"
    group = "States"

    def lacking(self, physics: Physics) -> str | None:
        """Instances that have a shape instead of a pose."""
        return None if physics.shapes else "nothing that changes its shape"

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`, in pixels."""
        ids = [instance_id(rollout, name) for name in physics_of(rollout).shapes]
        pairs = zip(rollout.observed.masks, rollout.masks, strict=True)
        errors = [[_apart(seen == i, true == i) for i in ids] for seen, true in pairs]
        return row_means(np.array(errors))


class HeightError(PhysicalMetric):
    """How much higher or lower sand or water stands than it should, mean over places.

    Of sand, in every cell of a map of the table; of water, what has run into the container, as
    high as it would stand there at rest.
    """

    name = "height_error"
    unit = "m"
    group = "States"

    def lacking(self, physics: Physics) -> str | None:
        """Surfaces whose height is read."""
        return None if physics.levels else "no surface whose height is read"

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`, in m."""
        true, start = truth_of(rollout), start_of(rollout)
        errors = [
            np.abs(measured(level, rollout) - level.measure(true, start))
            for level in physics_of(rollout).levels
        ]
        return row_means(np.concatenate(errors, axis=1))


def counts(masks: NDArray[np.uint8], ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many pixels instances have in each frame, `[T, n]`."""
    frames = len(masks)
    keys = np.arange(frames)[:, None, None] * 256 + masks
    return np.bincount(keys.ravel(), minlength=frames * 256).reshape(frames, 256)[:, ids]


def _apart(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    """The mean distance of two outlines; NaN if either is hardly there."""
    if min(first.sum(), second.sum()) < MIN_AREA * first.size:
        return float("nan")
    a, b = (np.argwhere(mask & ~_inner(mask)) for mask in (first, second))
    there, back = KDTree(b).query(a)[0], KDTree(a).query(b)[0]
    return float(np.concatenate([there, back]).mean())


def _inner(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The pixels that are not at the edge; those at the border of the frame are."""
    return np.asarray(ndimage.binary_erosion(mask), np.bool_)
