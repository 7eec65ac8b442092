"""Whether things are as sharp as they should be."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.physics import Physics
from acwm_core.evaluation.metric import Prediction
from acwm_core.model.shapes import Clip
from acwm_metrics.physical import MIN_AREA, PhysicalMetric, counts, ids_of, physics_of, row_means


class Sharpness(PhysicalMetric):
    """How the energy of the gradients within objects compares with the true one, mean over objects.

    The energy is the sum of squared differences of neighbouring pixels over all pixels where the
    true video shows the object. The score is the smaller energy over the larger one: 1 is as sharp,
    0.5 is half the energy (blurred) or twice of it (noise). What is not at its place has little.
    """

    name = "sharpness"
    bounds = (0.0, 1.0)
    higher_is_better = True
    group = "States"

    def lacking(self, physics: Physics) -> str | None:
        return None if physics.objects or physics.shapes else "no objects to be sharp"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The ratio of energies in each frame, `[T]`, in [0, 1]."""
        physics, masks = physics_of(prediction), prediction.masks
        ids = ids_of(prediction, [*dict.fromkeys((*physics.objects, *physics.shapes))])
        seen, true = (_energy(video) for video in (prediction.video, prediction.target))
        sums = [
            [np.einsum("thw,thw->t", energy, masks == each) for energy in (seen, true)]
            for each in ids
        ]
        low, high = np.sort(np.array(sums), axis=1).transpose(1, 2, 0)
        there = (counts(masks, ids) >= MIN_AREA * masks[0].size) & (high > 0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return row_means(np.where(there, low / high, np.nan))


def _energy(video: Clip) -> NDArray[np.float64]:
    """Squared gradients of each pixel, summed over channels and directions, `[T, H, W]`."""
    along = np.gradient(video.numpy().astype(np.float64), axis=(2, 3))
    return np.square(along).sum((0, 2))
