"""The metric: compares where the prediction shows the bob with where it really was."""

import numpy as np
from numpy.typing import NDArray

from acwm_core.evaluation.metric import Metric, Prediction


class AngleError(Metric):
    """Degrees between the true angle and that of the red pixels' centre; 180 if none is red."""

    name = "angle_error"
    title = "Angle error"
    unit = "°"
    group = "States"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The error of each frame, `[T]`."""
        truth = prediction.states["angle"].astype(np.float64)
        red, green, blue = prediction.video.double().unbind(1)
        redness = (red - green.maximum(blue) - 0.2).clamp(min=0).numpy()
        rows, columns = redness.shape[1:]
        y, x = np.mgrid[:rows, :columns]
        y, x = y - (rows - 1) / 2, x - (columns - 1) / 2  # from the pivot, the frame's centre
        seen = np.arctan2((redness * x).sum((1, 2)), (redness * y).sum((1, 2)))
        error = np.abs((seen - truth + np.pi) % (2 * np.pi) - np.pi)
        return np.where(redness.any((1, 2)), np.degrees(error), 180.0)
