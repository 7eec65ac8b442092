"""A script that fills pour_water's container to a given level."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from acwm_particle.cup import THICKNESS
from acwm_particle.water import Water
from acwm_particle.water_policy import MAX_STEP, Pourer

_ASIDE, _ABOVE = 0.22, 0.2
"""Distances in metres of the pouring cup's lip from the container's wall and above its rim."""

_DRAIN = 8
"""Frames until the water in the air has come down."""

_RUN_ON = 6.3
"""Frames of the current flow that still leave the cup while it is tilted back."""

_NEAR = 0.01
"""Share of the water that may be missing."""

_STEEPEST = 2.2
"""Tilt in rad at which the cup is empty."""


class Filler(Pourer):
    """Pours a share of the water into the container, a little less at first, then the rest.

    Args:
        water: water, cup and container, changed only through actions.
        wanted: share of all water that should be in the container.
        rng: only used by the base class.
    """

    def __init__(self, water: Water, wanted: float, rng: np.random.Generator) -> None:
        self._wanted = wanted
        super().__init__(water, rng)

    def _play(self) -> Iterator[NDArray[np.float64]]:
        tilt = self._flows_at() - 0.17
        container = self.cup.container
        lip = np.array([*self.cup.place, container.tall + THICKNESS + _ABOVE])
        lip[0] -= container.inner - _ASIDE
        for place, lean in ((lip - [0.4, 0, -0.15], 0.5 * tilt), (lip, tilt)):
            yield from self._go([*self._clear(place, lean), lean], 0.8)
        while self._left() > _NEAR:
            flow = 0.0
            while self._left() - _RUN_ON * flow > _NEAR / 2 and tilt < _STEEPEST:
                before = self._poured()
                tilt += 0.02 if flow < 0.001 else 0.004 + 0.03 * min(0.2, self._left())
                yield self._towards([*self._clear(lip, tilt), tilt], 1.0)
                flow = 0.5 * flow + 0.5 * (self._poured() - before)
            tilt -= 0.3
            yield from self._go([*self._clear(lip, tilt), tilt], 1.0)
            yield from self._wait(_DRAIN)
        while True:
            yield np.zeros(4)

    def _poured(self) -> float:
        """Share of all water that has left the cup."""
        return 1.0 - float(self.water.shares()[0])

    def _left(self) -> float:
        """Share of all water that still has to leave the cup."""
        return self._wanted - self._poured()

    def _towards(self, goal: list[float], pace: float) -> NDArray[np.float64]:
        """A step of the target, without noise."""
        gap = np.asarray(goal) - self.cup.target
        return gap * min(1.0, pace / max(float((np.abs(gap) / MAX_STEP).max()), 1e-9))
