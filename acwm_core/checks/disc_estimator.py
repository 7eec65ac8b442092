"""Reads the disc by its colour: the estimator with which metrics of physics are tried."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch.nn.functional import avg_pool2d

from acwm_core.checks.disc import WALL
from acwm_core.estimator import (
    Constant,
    Gap,
    Level,
    Observation,
    Physics,
    Reading,
    StateEstimator,
    States,
)
from acwm_core.shapes import Clip

REDNESS = 0.35
"""How much more red than green a pixel at the disc's edge is; 5 × 5 pixels are averaged."""


class DiscEstimator(StateEstimator):
    """Sees where the picture is red."""

    fields = ("position", "bearing")
    instances = ("disc",)

    @property
    def physics(self) -> Physics:
        """One disc that stays as large as it is, within walls."""
        return Physics(
            readings=(
                Reading("position", "position", ("disc",)),
                Reading("bearing", "angle", ("disc",)),
            ),
            objects=("disc",),
            shapes=("disc",),
            levels=(Level("disc", _height),),
            constants=(
                Constant("diameter", "length", _diameter, 0.1),
                Constant("area", "amount", _area, 0.2),
            ),
            gaps=(Gap("wall", ("background", "disc"), _to_wall, touch=0.004, solid=0.02),),
        )

    def estimate(self, video: Clip) -> Observation:
        """Masks, and the middle of the pixels of the disc; NaN where there are none."""
        red = avg_pool2d(video[:, 0] - video[:, 1], 5, 1, 2, count_include_pad=False).numpy()
        masks = (red > REDNESS).astype(np.uint8)
        rows, columns = np.indices(masks.shape[1:]) + 0.5
        pixels = masks.sum((1, 2))
        height, width = masks.shape[1:]
        with np.errstate(invalid="ignore", divide="ignore"):
            x = ((masks * columns).sum((1, 2)) / pixels - width / 2) / height
            y = (masks * rows).sum((1, 2)) / pixels / height - 0.5
        position = np.stack([x, y], 1).astype(np.float32)
        return Observation(masks, {"position": position, "bearing": np.arctan2(y, x)})

    def pixels(self, field: str, values: NDArray[Any]) -> NDArray[np.float64]:
        """A frame is 1 m high, its middle the origin."""
        height, width = self.card.frame_size
        return np.asarray(values, np.float64) * height + np.array([width, height]) / 2


def _height(seen: Observation, start: States) -> NDArray[np.float64]:
    return -np.asarray(seen.states["position"], np.float64)[:, 1:]


def _area(seen: Observation, start: States) -> NDArray[np.float64]:
    """In m²."""
    height = seen.masks.shape[1]
    return (seen.masks == 1).sum((1, 2)) / float(height) ** 2


def _diameter(seen: Observation, start: States) -> NDArray[np.float64]:
    return 2 * np.sqrt(_area(seen, start) / np.pi)


def _to_wall(seen: Observation, start: States) -> NDArray[np.float64]:
    """How far the middle of the disc can still go; it stops at WALL."""
    return WALL - np.abs(np.asarray(seen.states["position"], np.float64)).max(1)
