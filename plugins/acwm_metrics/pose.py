"""Where bodies are and how they lie, in the predicted video and in truth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acwm_core.estimator import Physics, Reading
from acwm_core.metric import Rollout
from acwm_metrics.physical import (
    PhysicalMetric,
    physics_of,
    row_means,
)
from acwm_metrics.turns import angle_between, turn_between


class PositionError(PhysicalMetric):
    """Distance of bodies from where the simulator has them, mean over bodies.

    A rope's is the mean over its points, from whichever end they fit better. What is not seen has
    no position and is left out: see `mask_iou` and `permanence`.
    """

    name = "position_error"
    unit = "m"

    def lacking(self, physics: Physics) -> str | None:
        """Readings of positions."""
        return None if _of(physics, "position", "curve") else "no position that is read"

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`, in m."""
        return _mean_over_rows(rollout, _of(physics_of(rollout), "position", "curve"))


class OrientationError(PhysicalMetric):
    """Angle between how bodies lie and how they should, mean over bodies.

    Of a cube's turns that all look the same, the nearest counts.
    """

    name = "orientation_error"
    unit = "rad"

    def lacking(self, physics: Physics) -> str | None:
        """Readings of angles."""
        return None if _of(physics, "angle", "quaternion") else "no angle that is read"

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`, in rad."""
        return _mean_over_rows(rollout, _of(physics_of(rollout), "angle", "quaternion"))


class PixelPositionError(PositionError):
    """The same distances as they appear in the picture, in pixels of the frame as it is."""

    name = "position_error_px"
    unit = "px"

    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """Of each frame, `[T]`, in pixels."""
        readings = _of(physics_of(rollout), "position", "curve")
        return _mean_over_rows(rollout, readings, in_pixels=True)


def _of(physics: Physics, *kinds: str) -> list[Reading]:
    return [reading for reading in physics.readings if reading.kind in kinds]


def _mean_over_rows(
    rollout: Rollout, readings: list[Reading], *, in_pixels: bool = False
) -> NDArray[np.float64]:
    return row_means(np.concatenate([_errors(rollout, each, in_pixels) for each in readings], 1))


def _errors(rollout: Rollout, reading: Reading, in_pixels: bool) -> NDArray[np.float64]:
    """How wrong each row of a reading is, `[T, n]`; NaN for rows that do not exist."""
    seen, true = reading.of(rollout.observed.states), reading.of(rollout.states)
    if in_pixels and rollout.estimator is not None:
        seen, true = (rollout.estimator.pixels(reading.field, each) for each in (seen, true))
    if reading.kind == "curve":
        ways = [np.linalg.norm(seen - each, axis=-1).mean(1) for each in (true, true[:, ::-1])]
        return np.minimum(*ways)[:, None]
    if reading.kind == "angle":
        errors = angle_between(seen, true, reading.symmetry)
    elif reading.kind == "quaternion":
        errors = turn_between(seen, true, reading.symmetry)
    else:
        errors = np.linalg.norm(seen - true, axis=-1)
    errors = errors.reshape(len(errors), -1)
    if reading.present:
        there = np.asarray(rollout.states[reading.present]).reshape(errors.shape) > 0
        errors = np.where(there, errors, np.nan)
    return errors
