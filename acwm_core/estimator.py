"""The `StateEstimator` interface: reads the state of an environment from frames."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.environment import EnvironmentCard
from acwm_core.physics import Observation, Physics

if TYPE_CHECKING:
    from acwm_core.shapes import Clip


class StateEstimator(ABC):
    """A measuring instrument: what a video of one environment shows, without its simulator.

    It is registered under the name of the environment that it reads, and constructed with the
    environment's card, whose frame size is that of the videos. It looks at frames alone: neither
    at actions nor at the truth, and a simulated and a predicted video are read alike.

    One instance reads many clips, several at once in different threads.

    Args:
        card: of the environment, or of a dataset of it.

    Attributes:
        card: the same.
        fields: names of the state fields that it reads.
        instances: names of the instances that its masks tell apart; pixels of the others are 0.

    Raises:
        ShapeError: the card is not that of the environment, for it lacks instances that are read.
    """

    fields: tuple[str, ...]
    instances: tuple[str, ...]

    def __init__(self, card: EnvironmentCard) -> None:
        self.card = card

    @property
    @abstractmethod
    def physics(self) -> Physics:
        """What can be measured in its observations."""

    def provenance(self) -> Mapping[str, str]:
        """What its readings depend on, e.g. the hash of the weights of a network."""
        return {}

    @abstractmethod
    def estimate(self, video: Clip) -> Observation:
        """Masks of `instances` and the states `fields` of a video.

        Args:
            video: `[T, 3, H, W]` float in [0, 1], H and W as on the card.

        Raises:
            ShapeError: frames of another size.
        """

    @abstractmethod
    def pixels(self, field: str, values: NDArray[Any]) -> NDArray[np.float64]:
        """Where positions appear in a frame, of estimates and of the truth alike.

        Args:
            field: a field of `fields` that holds positions or points of a curve.
            values: `[…, D]` in m, as on the card.

        Returns:
            `[…, 2]`: x to the right and y down, in pixels of a frame of the card's size, from its
            upper left corner.
        """
