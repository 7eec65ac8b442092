"""What all metrics of physics share: they compare what a video shows, not its pixels."""

from __future__ import annotations

import warnings
from abc import abstractmethod

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import EnvironmentCard
from acwm_core.errors import PluginError
from acwm_core.estimator import Constant, Gap, Level, Observation, Physics, StateEstimator, States
from acwm_core.metric import Metric, Rollout


class PhysicalMetric(Metric):
    """A metric of what an estimator sees in the predicted video.

    The estimator errs too: what the true video scores is the noise floor, below which a score says
    nothing of the model.
    """

    group = "Physics"

    def unavailable(self, card: EnvironmentCard, estimator: StateEstimator | None) -> str | None:
        """Nothing can be measured where no estimator reads the video, or it lacks the quantity."""
        if estimator is None:
            return f"no estimator reads the video of {card.name}"
        lacking = self.lacking(estimator.physics)
        return f"{card.name} has {lacking}" if lacking else None

    @abstractmethod
    def lacking(self, physics: Physics) -> str | None:
        """What an environment lacks for this metric, as in "no contacts"; None if it lacks none."""


def physics_of(rollout: Rollout) -> Physics:
    """What there is to measure in a clip.

    Raises:
        PluginError: no estimator was given.
    """
    if rollout.estimator is None:
        raise PluginError(f"no estimator reads the video of {rollout.card.name}")
    return rollout.estimator.physics


def truth_of(rollout: Rollout) -> Observation:
    """What the simulator knows, in the form in which the prediction is observed."""
    return Observation(rollout.masks, rollout.states)


def start_of(rollout: Rollout) -> States:
    """The simulator's states in the first frame."""
    return {name: values[0] for name, values in rollout.states.items()}


def measured(quantity: Constant | Gap | Level, rollout: Rollout) -> NDArray[np.float64]:
    """A quantity in each frame of the prediction, see `Measure`."""
    key = ("measured", quantity.measure)
    return rollout.once(key, lambda: quantity.measure(rollout.observed, start_of(rollout)))


def instance_id(rollout: Rollout, name: str) -> int:
    """The id of an instance in masks and contacts."""
    return rollout.card.instances.index(name)


def row_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean over the last axis of what is not NaN; NaN where nothing is."""
    with warnings.catch_warnings():  # an empty row is no mistake here
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmean(values, axis=-1)
