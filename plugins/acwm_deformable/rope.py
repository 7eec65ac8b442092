"""The physics of push_rope: a flexible rope on a table, and an upright pole that pushes it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_deformable.kernels import rope_solver as at
from acwm_deformable.kernels.rope_solver import advance_rope
from acwm_deformable.physics import POLE_RADIUS
from acwm_deformable.states import NODES, ROPE_RADIUS
from acwm_sim import engine

GRAVITY = 9.81

DENSITY = 1.5
"""Mass per length, kg/m."""

POLE_ROOM = (1.12, 1.0)
"""Half width and half depth in metres of the rectangle in which the pole moves."""

SUBSTEPS, PASSES = 25, 4
"""Substeps in a frame of a tenth of a second, and passes per substep."""

_LIMIT = np.array(POLE_ROOM, np.float32)
_MAX_PAIRS = 8 * NODES  # most pairs in contact; balls in a plane have at most six neighbours


@dataclass(frozen=True)
class Cord:
    """The material of a rope, and its friction.

    Attributes:
        length: rest length from the first to the last node, metres.
        radius: metres.
        stiffness: bending stiffness B, N·m²: the moment that bends the rope to curvature κ is B κ.
        friction: Coulomb coefficient on the table.
        pole_friction: Coulomb coefficient on the pole.
        self_friction: Coulomb coefficient of rope on rope.
    """

    length: float
    radius: float = ROPE_RADIUS
    stiffness: float = 0.05
    friction: float = 0.5
    pole_friction: float = 0.3
    self_friction: float = 0.2

    @property
    def spacing(self) -> float:
        """Rest length of a segment, metres."""
        return self.length / (NODES - 1)


class Rope:
    """A simulated rope and the pole.

    Args:
        cord: its material and surroundings.
        nodes: [NODES, 2] starting positions in metres.
        pole: [2] starting position of the pole in metres.
    """

    def __init__(self, cord: Cord, nodes: ArrayLike, pole: ArrayLike) -> None:
        engine.start()
        self.cord = cord
        self.nodes = np.array(nodes, np.float32)
        self.velocities = np.zeros_like(self.nodes)
        self.pole = np.array(pole, np.float32)
        self.touched = False
        self._old, self._drag = np.empty_like(self.nodes), np.zeros_like(self.nodes)
        self._tension = np.zeros(NODES - 1, np.float32)
        self._work, self._band = np.empty((NODES, 4), np.float32), np.empty((NODES, 3), np.float32)
        self._p, self._move = np.zeros(at.LENGTH, np.float32), np.zeros(2, np.float32)
        self._touched = np.zeros(1, np.int32)
        self._launch = engine.Launcher(advance_rope)
        self._pairs, self._count = np.zeros((_MAX_PAIRS, 2), np.int32), np.zeros(1, np.int32)

    def advance(
        self,
        move: ArrayLike,
        seconds: float = 0.1,
        *,
        substeps: int = SUBSTEPS,
        passes: int = PASSES,
    ) -> None:
        """Move the pole by `move` ([2], metres) at constant speed while simulating `seconds`.

        The pole stops at the edge of `POLE_ROOM`. Afterwards `touched` says whether rope and pole
        touched meanwhile.
        """
        goal = np.clip(self.pole + np.asarray(move, np.float32), -_LIMIT, _LIMIT)
        self._p[:], self._move[:] = self._numbers(seconds / substeps), goal - self.pole
        self._touched[:] = 0
        self._launch(
            self.nodes,
            self._old,
            self.velocities,
            self._drag,
            self._tension,
            self._work,
            self._band,
            self._pairs,
            self._count,
            self._p,
            self.pole,
            self._move,
            self._touched,
            substeps,
            passes,
        )
        self.touched = bool(self._touched[0])

    def _numbers(self, dt: float) -> NDArray[np.float32]:
        """The kernel's argument `p`."""
        cord, p = self.cord, np.zeros(at.LENGTH, np.float32)
        mass = DENSITY * cord.length / NODES
        p[at.DT], p[at.SPACING] = dt, cord.spacing
        p[at.BEND] = cord.stiffness * dt**2 / (mass * cord.spacing**3)
        p[at.GRIP] = cord.friction * GRAVITY * dt**2
        p[at.RADIUS], p[at.POLE_RADIUS] = cord.radius, POLE_RADIUS
        p[at.POLE_FRICTION], p[at.SELF_FRICTION] = cord.pole_friction, cord.self_friction
        # A strand that turns back as tightly as possible, in a half circle of the rope's own
        # radius, touches itself after π radii.
        p[at.APART] = np.ceil(np.pi * cord.radius / cord.spacing)
        return p
