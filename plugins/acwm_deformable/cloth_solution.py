"""A script that carries the cloth over the sphere to a goal position."""

import numpy as np
from numpy.typing import NDArray

from acwm_deformable.cloth import ROOM, Cloth
from acwm_deformable.cloth_policy import Carrier, Steps

_OVER = 0.12
"""Height in metres above the sphere at which the edge crosses it."""


def beyond(cloth: Cloth, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw a goal [3] in metres for the middle of the grippers, on the far side of the sphere."""
    here = cloth.hands.mean(0, dtype=np.float64)
    angle = np.arctan2(-here[1], -here[0]) + rng.normal(0, 0.3)
    out = cloth.sheet.sphere + rng.uniform(0.1, 0.3)
    place = [out * np.cos(angle), out * np.sin(angle), rng.uniform(0.1, 0.4)]
    lean = cloth.hands - here
    low, high = np.transpose(ROOM)
    return np.clip(place, (low - lean).max(0), (high - lean).min(0))


class Bringer(Carrier):
    """Moves both grippers over the sphere to a goal position, and stays there.

    Args:
        cloth: the simulation, which it observes.
        longest: largest step along each axis in a frame, metres.
        place: [3], goal for the middle of the grippers in metres.
        rng: not used.
    """

    def __init__(
        self, cloth: Cloth, longest: float, place: NDArray[np.float64], rng: np.random.Generator
    ) -> None:
        self._place = place
        super().__init__(cloth, longest, rng)

    def live(self) -> Steps:
        """Move up, across and down, then wait."""
        self.speed = 0.05
        height = max(self._top + _OVER, float(self.middle[2]))
        yield from self.go(np.append(self.middle[:2], height), near=0.05)
        yield from self.go(np.append(self._place[:2], height), near=0.04)
        while True:
            yield from self.go(self._place)
            yield from self.rest(1)
