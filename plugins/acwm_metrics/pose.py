"""Compares positions and orientations of bodies in the predicted video with the truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.physics import Physics, Reading
from acwm_core.env.rotations import FOLDS, angle_difference, product, rotations_of
from acwm_core.env.state_field import SYMMETRIES, BodySymmetry
from acwm_core.evaluation.metric import Prediction
from acwm_metrics.physical import PhysicalMetric, physics_of, row_means
from acwm_metrics.seen import exist, held_of, seen_of, share_found, shown

LARGEST = {
    **{symmetry: np.pi / FOLDS[symmetry] for symmetry in SYMMETRIES["angle"]},
    "box": 2 * np.pi / 3,
    "cube": 2 * np.arccos((1 + 2**0.5) / 8**0.5),
}
"""The largest angle between two orientations of a body, by symmetry, in rad."""


class PositionError(PhysicalMetric):
    """Distance of bodies from their true positions, mean over bodies.

    The distance of a rope is the mean over its points, counted from the end that fits better. A
    body that is not found, though the true video shows it, counts at its last seen place. One that
    neither shows is left out.
    """

    name = "position_error"
    definition = 2
    unit = "m"
    group = "States"

    def lacking(self, physics: Physics) -> str | None:
        return None if physics.positions else "no position that is read"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The distance in each frame, `[T]`, in m."""
        return _mean_over_rows(prediction, physics_of(prediction).positions)

    def coverage(self, prediction: Prediction, curve: NDArray[np.float64]) -> float:
        """Share of the bodies and frames in which a place is found."""
        return share_found(prediction, physics_of(prediction).positions)


class OrientationError(PhysicalMetric):
    """Angle between predicted and true orientations of bodies, mean over bodies.

    Orientations that look the same, as of a cube, count as equal: the nearest one is used. A body
    that is not found, though the true video shows it, counts with the largest angle there can be:
    its last orientation could be better than a true one that is late. One that neither shows is
    left out.
    """

    name = "orientation_error"
    definition = 2
    unit = "rad"
    group = "States"

    def lacking(self, physics: Physics) -> str | None:
        return None if _of(physics, "angle", "quaternion") else "no angle that is read"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The angle in each frame, `[T]`, in rad."""
        return _mean_over_rows(prediction, _of(physics_of(prediction), "angle", "quaternion"))

    def coverage(self, prediction: Prediction, curve: NDArray[np.float64]) -> float:
        """Share of the bodies and frames in which an orientation is found."""
        return share_found(prediction, _of(physics_of(prediction), "angle", "quaternion"))


class PixelPositionError(PositionError):
    """The distances of `position_error` as seen in the frame, in pixels of its own size."""

    name = "position_error_px"
    title = "Position error (px)"
    unit = "px"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The distance in each frame, `[T]`, in pixels."""
        readings = physics_of(prediction).positions
        return _mean_over_rows(prediction, readings, in_pixels=True)


def _of(physics: Physics, *kinds: str) -> list[Reading]:
    return [reading for reading in physics.readings if reading.kind in kinds]


def _mean_over_rows(
    prediction: Prediction, readings: list[Reading], *, in_pixels: bool = False
) -> NDArray[np.float64]:
    return row_means(np.concatenate([_errors(prediction, each, in_pixels) for each in readings], 1))


def _errors(prediction: Prediction, reading: Reading, in_pixels: bool) -> NDArray[np.float64]:
    """Error of each row of a reading, `[T, n]`; NaN for rows that do not exist or nobody sees."""
    seen, true = reading.of(held_of(prediction).states), reading.of(prediction.states)
    if in_pixels and prediction.estimator is not None:
        seen, true = (prediction.estimator.pixels(reading.field, each) for each in (seen, true))
    if reading.kind == "curve":
        ways = [np.linalg.norm(seen - each, axis=-1).mean(1) for each in (true, true[:, ::-1])]
        return np.minimum(*ways)[:, None]
    if reading.kind in ("angle", "quaternion"):
        errors = _turned(prediction, reading)
    else:
        errors = np.linalg.norm(seen - true, axis=-1)
    errors = errors.reshape(len(errors), -1)
    return np.where(exist(prediction, reading), errors, np.nan) if reading.present else errors


def _turned(prediction: Prediction, reading: Reading) -> NDArray[np.float64]:
    """Angle to the true orientation of each body, `[T, n]`; the largest one if it is not found."""
    seen, true = reading.of(seen_of(prediction).states), reading.of(prediction.states)
    between = angle_between if reading.kind == "angle" else turn_between
    errors = between(seen, true, reading.symmetry).reshape(len(seen), -1)
    lost = np.isnan(errors) & shown(prediction, reading.instances)
    return np.where(lost, LARGEST[reading.symmetry], errors)


def angle_between(
    first: NDArray[np.floating], second: NDArray[np.floating], symmetry: BodySymmetry
) -> NDArray[np.float64]:
    """The smaller angle between two angles of a body that has a symmetry, in rad."""
    return np.abs(angle_difference(first, second, FOLDS[symmetry]))


def turn_between(
    first: NDArray[np.floating], second: NDArray[np.floating], symmetry: BodySymmetry
) -> NDArray[np.float64]:
    """The smallest rotation angle from one orientation to any that looks like the other.

    Args:
        first: quaternions `[…, 4]` (w, x, y, z) of any length except 0.
        second: like `first`.
        symmetry: symmetry of the body, in its own frame.

    Returns:
        Angles `[…]` in [0, π] rad.
    """
    unit = [
        np.asarray(q, np.float64) / np.linalg.norm(q, axis=-1)[..., None] for q in (first, second)
    ]
    same = product(unit[0][..., None, :], rotations_of(symmetry))
    cosines = np.abs((same * unit[1][..., None, :]).sum(-1)).max(-1)
    return 2 * np.arccos(np.clip(cosines, 0, 1))
