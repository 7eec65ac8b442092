"""The physics of cloth_move: a sheet of cloth, a sphere on the ground and grippers."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_deformable.kernels import cloth_solver as at
from acwm_deformable.kernels.cloth_layers import BUCKETS
from acwm_deformable.kernels.cloth_step import advance_cloth
from acwm_deformable.physics import HAND_RADIUS
from acwm_sim import engine

GRAVITY = 9.81

THICKNESS = 0.006
"""Distance between the middle of the cloth and the surface below it, metres."""

GRASP_REACH = 0.05
"""Distance in metres within which a closing gripper catches the nearest node."""

SUBSTEPS = 24
"""Substeps in a frame of a tenth of a second."""

ROOM = ((-0.62, 0.62), (-0.55, 0.55), (HAND_RADIUS, 0.95))
"""Range of the gripper positions: x, y, z in metres."""

MAX_STRAIN = 0.05
"""Strain of an edge above which a frame is repeated with shorter steps of the grippers."""

_EFFORTS = (1.0, 0.4, 0.0, -0.5)  # shares of a step to try in turn; the last one moves back
_SHEAR_STIFFNESS = 1.5  # newtons per metre of a diagonal
_MIN_SOFTNESS = 1.0  # least s of bending: closer to 0, a single pass would oscillate
_LAYER = 1.1  # distance of two layers in edges, so that no node slips through a cell
_LAYER_FRICTION = 0.2
_MAX_PAIRS = 24  # candidates for contact per node


@dataclass(frozen=True)
class Sheet:
    """The material of the cloth, and its surroundings.

    Attributes:
        columns: number of nodes across; edges have the same length down and across.
        spacing: rest length of an edge between neighbours, metres.
        density: kg/m².
        stiffness: bending stiffness, N·m.
        friction: Coulomb coefficient on sphere and ground.
        drag: force of the air per area and speed, N·s/m³.
        sphere: radius in metres of the sphere that stands on the ground at the origin.
    """

    columns: int
    spacing: float
    density: float = 0.2
    stiffness: float = 6e-5
    friction: float = 0.3
    drag: float = 0.1
    sphere: float = 0.2


class Cloth:
    """A simulated sheet and the grippers that hold it.

    Args:
        sheet: its material and surroundings.
        nodes: [rows · columns, 3] starting positions in metres, row by row.
        hands: [K, 3] starting positions of the grippers.
        held: node that each gripper holds, or -1.
        together: whether the grippers form one body, so that what stops one stops all.
    """

    def __init__(
        self,
        sheet: Sheet,
        nodes: ArrayLike,
        hands: ArrayLike,
        held: Sequence[int],
        *,
        together: bool = False,
    ) -> None:
        engine.start()
        self.sheet, self.together = sheet, together
        self.nodes = np.array(nodes, np.float32)
        self.velocities = np.zeros_like(self.nodes)
        self.hands = np.array(hands, np.float32)
        self.held = np.full(len(held), -1, np.int32)
        self.touched = np.zeros(2 + len(held), np.int32)
        count = len(self.nodes)
        self._old, self._free = self.nodes.copy(), np.ones(count, np.float32)
        self._offset, self._wish = np.zeros_like(self.hands), np.zeros_like(self.hands)
        self._start, self._item = np.zeros(BUCKETS + 1, np.int32), np.zeros(count, np.int32)
        self._pairs = np.zeros((_MAX_PAIRS * count, 2), np.int32)
        self._strain = np.zeros(1, np.float32)
        self._p, self._step = np.zeros(at.LENGTH, np.float32), np.zeros_like(self.hands)
        self._launch = engine.Launcher(advance_cloth)
        self._count = np.zeros(1, np.int32)
        for hand, node in enumerate(held):
            if node >= 0:
                self._hold(hand, node)

    @property
    def sphere_center(self) -> NDArray[np.float64]:
        """Centre of the sphere [3] in metres."""
        return np.array([0.0, 0.0, self.sheet.sphere])

    def advance(
        self, step: ArrayLike, seconds: float = 0.1, *, substeps: int = SUBSTEPS, drag: float = -1.0
    ) -> None:
        """Move the grippers by `step` ([K, 3], metres) while simulating `seconds`.

        Args:
            step: displacement. Grippers stop at the sphere, at the limits of `ROOM`, and where the
                cloth is taut (there they may even move back a little).
            seconds: simulated time.
            substeps: number of substeps in that time.
            drag: air drag to use instead of the sheet's (if not negative), to let it settle.

        Afterwards `touched` says what touched meanwhile: cloth and sphere, cloth and ground, then
        each gripper and the sphere.
        """
        self._p[:] = self._numbers(seconds / substeps, self.sheet.drag if drag < 0 else drag)
        before = [array.copy() for array in (self.nodes, self.velocities, self.hands)]
        for share in _EFFORTS:
            self.touched[:] = 0
            self._step[:] = np.multiply(step, share, dtype=np.float32)
            self._run(substeps)
            if self._strain[0] <= MAX_STRAIN or not np.any(step):
                break
            if share != _EFFORTS[-1]:
                for array, saved in zip(
                    (self.nodes, self.velocities, self.hands), before, strict=True
                ):
                    array[:] = saved

    def displace(self, shift: ArrayLike, turn: float) -> None:
        """Move cloth and grippers horizontally by `shift` ([2], metres) and `turn` rad about z.

        No time passes. They rotate about the middle of the grippers, which stay in their `ROOM`.
        """
        middle = self.hands[:, :2].mean(0, dtype=np.float64)
        c, s = np.cos(turn), np.sin(turn)
        for points in (self.nodes, self.hands):
            arms = (points[:, :2] - middle) @ np.array([[c, s], [-s, c]])
            points[:, :2] = middle + arms + shift
        low, high = np.transpose(ROOM)[:, :2]
        back = np.clip(self.hands[:, :2], low, high) - self.hands[:, :2]
        inward = back[np.abs(back).argmax(0), [0, 1]]  # the gripper that is further out decides
        for points in (self.nodes, self.hands):
            points[:, :2] += inward

    def mirror(self) -> None:
        """Mirror cloth and grippers, left to right."""
        for vectors in (self.nodes, self.velocities, self.hands, self._offset):
            vectors[:, 0] *= -1

    def _run(self, substeps: int) -> None:
        self._launch(
            self.nodes,
            self._old,
            self.velocities,
            self._free,
            self._p,
            self.held,
            self.hands,
            self._offset,
            self._step,
            self._wish,
            self._start,
            self._item,
            self._pairs,
            self._count,
            self.touched,
            self._strain,
            self.sheet.columns,
            substeps,
            int(self.together),
        )

    def release(self, hand: int) -> None:
        """Open a gripper and release its node."""
        if self.held[hand] >= 0:
            self._free[self.held[hand]] = 1
            self.held[hand] = -1

    def grasp(self, hand: int) -> bool:
        """Hold the nearest node, if one is in reach, and pull it in within a frame.

        Returns:
            Whether the gripper holds a node now.
        """
        if self.held[hand] < 0:
            away = np.linalg.norm(self.nodes - self.hands[hand], axis=1)
            away[self._free == 0] = np.inf
            node = int(np.argmin(away))
            if away[node] <= GRASP_REACH:
                self._hold(hand, node)
        return bool(self.held[hand] >= 0)

    def _hold(self, hand: int, node: int) -> None:
        self.held[hand] = node
        self._offset[hand] = self.nodes[node] - self.hands[hand]
        self._free[node] = 0

    def _numbers(self, dt: float, drag: float) -> NDArray[np.float32]:
        """The kernel's argument `p`."""
        sheet, p = self.sheet, np.zeros(at.LENGTH, np.float32)
        mass = sheet.density * sheet.spacing**2
        p[at.DT], p[at.GRAVITY], p[at.DRAG] = dt, GRAVITY, drag / sheet.density
        p[at.SPACING] = sheet.spacing
        p[at.SHEAR] = max(mass / (_SHEAR_STIFFNESS * dt**2) - 2, 0)
        # If neighbours alone cannot be that stiff, nodes two edges apart take the rest.
        unit = mass * sheet.spacing**2 / dt**2
        near = min(sheet.stiffness, unit / (6 + _MIN_SOFTNESS))
        p[at.BEND], p[at.WIDE] = unit / near - 6, -1
        if sheet.stiffness > near:
            p[at.WIDE] = max(16 * unit / (sheet.stiffness - near) - 6, _MIN_SOFTNESS)
        p[at.FRICTION], p[at.THICKNESS] = sheet.friction, THICKNESS
        p[at.LAYER], p[at.LAYER_FRICTION] = _LAYER * sheet.spacing, _LAYER_FRICTION
        p[at.SPHERE : at.SPHERE + 3], p[at.SPHERE + 3] = self.sphere_center, sheet.sphere
        p[at.HAND], p[at.BOX : at.BOX + 6] = HAND_RADIUS, np.ravel(ROOM)
        return p
