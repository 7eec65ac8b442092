"""The `Metric` interface: scores one predicted episode, and sums up many."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import EnvironmentCard
from acwm_core.shapes import Clip


@dataclass(frozen=True)
class Rollout:
    """A predicted clip beside the truth and all that the simulator knows of it.

    Attributes:
        prediction: `[T, 3, H, W]` float32 in [0, 1].
        target: the simulated video, like `prediction`; frame 0 was given to the model.
        actions: `[T, A]` raw actions.
        states: ground-truth arrays by name, each `[T, …]`.
        masks: `[T, H, W]` uint8 instance ids.
        contacts: `[K, 3]` rows (frame, id, id).
        card: the environment's card.
    """

    prediction: Clip
    target: Clip
    actions: NDArray[np.float32]
    states: Mapping[str, NDArray[Any]]
    masks: NDArray[np.uint8]
    contacts: NDArray[np.int32]
    card: EnvironmentCard


class Metric(ABC):
    """A score of predicted video, in float32 and outside autocast.

    One instance scores many clips, several at once in different threads: the methods keep nothing
    between calls and leave what they are given as it is.

    Attributes:
        name: column name in results, e.g. ``"psnr"``.
        unit: e.g. ``"dB"``; ``""`` for none.
        higher_is_better: which way is good.
    """

    name: str
    unit: str = ""
    higher_is_better: bool = False

    @abstractmethod
    def per_frame(self, rollout: Rollout) -> NDArray[np.float64]:
        """The score of each frame, `[T]`; NaN where it is not defined."""

    def value(self, rollout: Rollout) -> float:
        """The score of the whole clip; the mean of the defined frames unless overridden."""
        return float(np.nanmean(self.per_frame(rollout)))

    def weight(self, rollout: Rollout) -> float:
        """How much the clip counts in `summarise`; 1 unless overridden."""
        return 1.0

    def summarise(self, values: Sequence[float], weights: Sequence[float] | None = None) -> float:
        """One number for many clips: the weighted mean of their `value`s unless overridden.

        Args:
            values: `value` of each clip.
            weights: `weight` of each clip; all equal if None.
        """
        return float(np.average(values, weights=weights))
