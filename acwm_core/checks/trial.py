"""One environment under trial: the episodes that its checks look at."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.simulate import simulate
from acwm_core.environment import Environment, EnvironmentCard
from acwm_core.episode import Episode, EpisodeSpec, FactorSetting, Split

SMALL = 64
"""Frame height at which episodes are simulated, where the aspect ratio allows."""

BEGINNING = 48
"""Frames of the episodes that are simulated again and again, if the horizon is longer."""


class EnvironmentTrial:
    """An environment and one of its episodes, simulated on first use.

    Args:
        make: constructs the environment; takes `size`; picklable.
        subject: what the user asked to check.
    """

    def __init__(self, make: Callable[..., Environment], subject: object) -> None:
        self.make = make
        self.subject = subject
        self._episodes: dict[int, Episode] = {}

    @functools.cached_property
    def size(self) -> tuple[int, int]:
        """The smallest frame size of the card's aspect ratio that is no lower than `SMALL`."""
        height, width = self.make().card.frame_size
        for small in range(SMALL, height, 8):
            if small * width % (8 * height) == 0:
                return small, small * width // height
        return height, width

    @functools.cached_property
    def environment(self) -> Environment:
        """The environment at the small size."""
        return self.make(size=self.size)

    @property
    def card(self) -> EnvironmentCard:
        """Its card."""
        return self.environment.card

    @property
    def episode(self) -> Episode:
        """Training episode 0 under the environment's policy."""
        return self.training_episode(0)

    @functools.cached_property
    def beginning(self) -> Episode:
        """The first `BEGINNING` frames of `episode`, simulated on their own."""
        return self.simulate(self.spec(), frames=BEGINNING)

    def training_episode(self, index: int) -> Episode:
        """A training episode under the environment's policy, simulated once."""
        if index not in self._episodes:
            self._episodes[index] = self.simulate(self.spec(index=index))
        return self._episodes[index]

    def spec(
        self,
        split: Split = "train",
        index: int = 0,
        factors: Mapping[str, FactorSetting] | None = None,
    ) -> EpisodeSpec:
        """An episode of this environment."""
        return EpisodeSpec(self.card.name, split, index, factors=factors or {})

    def simulate(
        self,
        spec: EpisodeSpec,
        actions: NDArray[np.floating[Any]] | None = None,
        frames: int | None = None,
    ) -> Episode:
        """Simulate on the environment at the small size, to the horizon or fewer frames."""
        return simulate(self.environment, spec, actions, frames=frames)
