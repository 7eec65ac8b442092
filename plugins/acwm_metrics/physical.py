"""Shared by all metrics of physics, which compare the contents of a video, not its pixels."""

from __future__ import annotations

import math
import warnings
from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.physics import (
    Observation,
    Physics,
    StateEstimator,
    States,
)
from acwm_core.errors import PluginError
from acwm_core.evaluation.metric import Metric, Prediction

MIN_AREA = 5e-4
"""Share of the frame below which an instance is too small to judge: 2 pixels of 64 × 64."""

MIN_SHARE = 0.2
"""Share of an object's usual area below which it counts as not seen, and a part as no part."""

Mask = NDArray[np.bool_]


class PhysicalMetric(Metric):
    """A metric of what an estimator reads from the predicted video.

    The estimator has errors, too. The score of the true video is the noise floor: a score below it
    says nothing about the model.
    """

    group = "Physics"
    bounds = (0.0, math.inf)

    def unavailable(self, card: EnvironmentCard, estimator: StateEstimator | None) -> str | None:
        """It is unavailable without an estimator, or without the quantity in this environment."""
        if estimator is None:
            return f"no estimator reads the video of {card.name}"
        lacking = self.lacking(estimator.physics)
        return f"{card.name} has {lacking}" if lacking else None

    @abstractmethod
    def lacking(self, physics: Physics) -> str | None:
        """What an environment lacks for this metric, such as "no contacts"; None for nothing."""


def physics_of(prediction: Prediction) -> Physics:
    """What can be measured in a clip.

    Raises:
        PluginError: no estimator was given.
    """
    if prediction.estimator is None:
        raise PluginError(f"no estimator reads the video of {prediction.card.name}")
    return prediction.estimator.physics


def truth_of(prediction: Prediction) -> Observation:
    """The simulator's truth, in the form of an observation."""
    return Observation(prediction.masks, prediction.states)


def start_of(prediction: Prediction) -> States:
    """The simulator's states in the first frame."""
    return {name: values[0] for name, values in prediction.states.items()}


def instance_id(prediction: Prediction, name: str) -> int:
    """The id of an instance in masks and contacts."""
    return prediction.card.instances.index(name)


def ids_of(prediction: Prediction, names: Sequence[str]) -> NDArray[np.int64]:
    """The ids of instances, `[n]`."""
    return np.array([instance_id(prediction, name) for name in names], np.int64)


def counts(masks: NDArray[np.uint8], ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number of pixels of each instance in each frame, `[T, n]`."""
    frames = len(masks)
    keys = np.arange(frames)[:, None, None] * 256 + masks
    return np.bincount(keys.ravel(), minlength=frames * 256).reshape(frames, 256)[:, ids]


def usual_sizes(areas: NDArray[np.int64]) -> NDArray[np.float64]:
    """The median of areas `[T, n]` over the frames that show an instance, `[n]`; 0 without any."""
    return np.array([np.median(a[a > 0]) if a.any() else 0.0 for a in areas.T])


def row_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean over the last axis without NaN values; NaN where all are NaN."""
    with warnings.catch_warnings():  # a row of NaN is not an error here
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmean(values, axis=-1)
