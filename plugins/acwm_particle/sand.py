"""The physics of push_sand: grains on a table and a board that moves through them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_particle.kernels.neighbors import pack_grid
from acwm_particle.kernels.sand_step import MARGIN, sand_step
from acwm_sim import engine
from acwm_sim.engine import ti
from acwm_sim.geometry import rotations

SUBSTEPS, ITERATIONS = 10, 2
"""Substeps per frame, and iterations per substep."""

FRAME = 0.1
"""Duration of a frame in seconds."""

AIR = 0.3
"""Damping of all motion, 1/s."""

LOW, HIGH = np.array([-0.62, -0.42, 0.02]), np.array([0.62, 0.42, 0.32])
"""Bounds of the board's centre in metres; its lowest corner also stays above the ground."""

CLEARANCE = 0.003
"""Least distance in metres between the board and the ground."""

_MAX_NEIGHBORS = 24
_FAR = 1e3


@dataclass(frozen=True)
class Pose:
    """The pose of the board.

    Attributes:
        position: [3] its centre in metres.
        quaternion: [4] orientation (w, x, y, z); its flat side faces along its own x.
    """

    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Rotation matrix [3, 3]."""
        return rotations(np.roll(self.quaternion, -1)[None])[0]


class Sand:
    """Sand and a board.

    Args:
        grains: [N, 3] initial centres of the grains in metres.
        radius: radius of a grain in metres.
        friction: Coulomb coefficient between grains.
        half: [3] half sizes of the board in metres: thickness, width, height.

    Attributes:
        grains: [N, 3] float32, current centres in metres.
        velocities: [N, 3] float32, m/s.
        board: pose of the board.
        radius: radius of a grain in metres.
        half: half sizes of the board in metres.
        touches_board: whether a grain touched the board in the last frame.
        touches_ground: whether a grain touched the ground in the last frame.
    """

    def __init__(self, grains: ArrayLike, radius: float, friction: float, half: ArrayLike) -> None:
        engine.start()
        self.grains = np.array(grains, np.float32)
        self.velocities = np.zeros_like(self.grains)
        self.radius, self._friction = radius, friction
        self.half = np.asarray(half, np.float64)
        self.board = Pose(np.array([0.0, 0.0, _FAR]), np.array([1.0, 0.0, 0.0, 0.0]))
        self.touches_board = self.touches_ground = False
        count = len(self.grains)
        self._last, self._order = np.zeros_like(self.grains), np.zeros(count, np.int32)
        self._near = np.zeros((count, 1 + _MAX_NEIGHBORS), np.int32)
        self._held = np.zeros(count, np.int32)
        self._hit = np.zeros(2, np.int32)

    def settle(self, frames: int) -> None:
        """Let the sand come to rest without a board.

        Stronger damping slows the fall in the first frames. It must not last, because grains held
        up on a slope would roll down later.
        """
        for frame in range(frames):
            self._step(self.board, 6.0 if frame < 2 else AIR)
        self.velocities[:] = 0

    def put_board(self, pose: Pose) -> None:
        """Place the board; no time passes."""
        self.board = self._kept(pose)

    def wait(self) -> None:
        """Simulate a frame in which the board (if placed) stays where it is."""
        self._step(self.board, AIR)

    def advance(self, action: NDArray[np.float64]) -> None:
        """Simulate a frame in which the board moves by `action` [7]; see `PushSand`.

        Call `put_board` first: until then the board is far away.
        """
        quaternion = self.board.quaternion + action[3:]
        size = np.linalg.norm(quaternion)
        quaternion = quaternion / size if size > 1e-3 else self.board.quaternion
        self._step(self._kept(Pose(self.board.position + action[:3], quaternion)), AIR)

    def _step(self, pose: Pose, damping: float) -> None:
        path = self._path(pose)
        # The grid just covers the sand, as an empty cell costs as much as one with grains.
        low, high = self.grains.min(0) - self.radius, self.grains.max(0) + self.radius
        grid, cells = pack_grid(low, high, 2 * self.radius * MARGIN)
        self._hit[:] = 0
        sand_step(
            self.grains,
            self._last,
            self.velocities,
            path,
            ti.math.vec3(*self.half),
            grid,
            np.zeros(cells + 1, np.int32),
            self._order,
            self._near,
            self._held,
            self._hit,
            FRAME,
            ITERATIONS,
            self.radius,
            self._friction,
            damping,
        )
        self.board = pose
        self.touches_board, self.touches_ground = map(bool, self._hit)

    def _path(self, pose: Pose) -> NDArray[np.float32]:
        """The board's poses before and after each substep, [S + 1, 12]."""
        share = np.linspace(0, 1, SUBSTEPS + 1)[:, None]
        centers = self.board.position + share * (pose.position - self.board.position)
        turns = self.board.quaternion + share * (pose.quaternion - self.board.quaternion)
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        matrices = rotations(np.roll(turns, -1, axis=1)).reshape(-1, 9)
        return np.hstack([centers, matrices]).astype(np.float32)

    def _kept(self, pose: Pose) -> Pose:
        """Move a pose so that the board is within its bounds and above the ground."""
        below = float(np.abs(pose.rotation[2]) @ self.half)
        place = np.clip(pose.position, LOW, HIGH)
        place[2] = max(place[2], below + CLEARANCE)
        return Pose(place, pose.quaternion)
