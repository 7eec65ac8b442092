"""The physics of the table: cubes that slide, walls, and pushers that follow a target."""

import os
from dataclasses import dataclass

# MuJoCo would otherwise look for OpenGL on import; frames come from acwm_sim.
os.environ.setdefault("MUJOCO_GL", "disabled")

import mujoco
import numpy as np
from numpy.typing import NDArray

INNER = 0.30
"""Half width of the table between its walls, metres."""

WALL = 0.015
"""Half thickness of a wall, metres."""

WALL_HEIGHT = 0.03
"""Below the middle of a cube, so that a wall stops it without tipping it."""

PUSHER_RADIUS = 0.03

MAX_SPEED = 0.65
"""Speed limit of the point that a pusher follows, m/s."""

TIMESTEP = 0.005

WALL_ID, FIRST_BODY_ID = 1, 2
"""Instance ids: 0 the table, 1 the walls, then pushers, then cubes."""

# The actuators are critically damped: kv = 2 √(kp · mass). At 80 rad/s a pusher trails its
# reference by 25 ms, a quarter of a frame.
_PUSHER_MASS, _STIFFNESS = 0.5, 80.0
_FORCE_LIMIT = 12.0


@dataclass(frozen=True)
class Cubes:
    """The cubes of an episode.

    Attributes:
        slots: which of the possible cubes are there, increasing.
        xy: [n, 2] starting centres in metres.
        yaw: [n] starting angles in radians.
        edge: length of an edge in metres.
        mass: of one cube in kg.
        friction: Coulomb coefficient between a cube and the table, and between cubes.
    """

    slots: tuple[int, ...]
    xy: NDArray[np.float64]
    yaw: NDArray[np.float64]
    edge: float
    mass: float
    friction: float


class Table:
    """One episode's world. Built afresh each time, so nothing of another episode is left in it.

    Args:
        cubes: what lies on the table.
        pushers: [P, 2] starting positions in metres.
    """

    def __init__(self, cubes: Cubes, pushers: NDArray[np.float64]) -> None:
        self.cubes = cubes
        self.model = mujoco.MjModel.from_xml_string(_xml(cubes, len(pushers)))
        self.data = mujoco.MjData(self.model)
        self._pushers, self._bodies = len(pushers), 1 + len(pushers)
        self._instance = _instances(self.model, cubes, len(pushers))
        self.reference = np.array(pushers, np.float64)
        self.data.qpos[: 2 * self._pushers] = self.reference.ravel()
        for place, xy, yaw in zip(self._cube_qpos(), cubes.xy, cubes.yaw, strict=True):
            place[:3] = (*xy, cubes.edge / 2)
            place[3:] = (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
        self.data.ctrl[:] = self.reference.ravel()
        mujoco.mj_forward(self.model, self.data)

    def advance(self, target: NDArray[np.float64], seconds: float) -> set[tuple[int, int]]:
        """Move the pushers towards `target` ([P, 2], metres) for a while.

        Returns:
            The pairs of instance ids that touched at any time in between, the table left out.
        """
        touched: set[tuple[int, int]] = set()
        for _ in range(round(seconds / TIMESTEP)):
            gap = target - self.reference
            reach = np.linalg.norm(gap, axis=1, keepdims=True)
            self.reference += gap * np.minimum(1.0, MAX_SPEED * TIMESTEP / np.maximum(reach, 1e-9))
            self.data.ctrl[:] = self.reference.ravel()
            mujoco.mj_step(self.model, self.data)
            touched.update(map(tuple, self._instance[self.data.contact.geom].tolist()))
        return {pair for pair in touched if min(pair) > 0}

    @property
    def pusher_position(self) -> NDArray[np.float64]:
        """[P, 2] metres."""
        return self.data.qpos[: 2 * self._pushers].reshape(-1, 2).copy()

    @property
    def pusher_velocity(self) -> NDArray[np.float64]:
        """[P, 2] m/s."""
        return self.data.qvel[: 2 * self._pushers].reshape(-1, 2).copy()

    @property
    def cube_pose(self) -> NDArray[np.float64]:
        """[n, 7]: position in metres and unit quaternion (w, x, y, z)."""
        return self._cube_qpos().copy()

    @property
    def cube_velocity(self) -> NDArray[np.float64]:
        """[n, 6]: linear in the world frame (m/s), angular in the cube's own (rad/s)."""
        return self.data.qvel[2 * self._pushers :].reshape(-1, 6).copy()

    @property
    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """World positions [P + n, 3] and rotations [P + n, 3, 3] of pushers, then cubes."""
        mujoco.mj_kinematics(self.model, self.data)
        return self.data.xpos[1:].copy(), self.data.xmat[1:].reshape(-1, 3, 3).copy()

    def _cube_qpos(self) -> NDArray[np.float64]:
        return self.data.qpos[2 * self._pushers :].reshape(-1, 7)


def _instances(model: mujoco.MjModel, cubes: Cubes, pushers: int) -> NDArray[np.int64]:
    """Instance id of every geom; geoms are named after what they belong to."""
    first_cube = FIRST_BODY_ID + pushers
    ids = {"table": 0, "wall": WALL_ID}
    ids |= {f"pusher{k}": FIRST_BODY_ID + k for k in range(pushers)}
    ids |= {f"cube{k}": first_cube + slot for k, slot in enumerate(cubes.slots)}
    return np.array([ids[model.geom(g).name.split("/")[0]] for g in range(model.ngeom)])


def _xml(cubes: Cubes, pushers: int) -> str:
    """The MuJoCo model.

    Pushers and walls have priority in contacts, so their own friction counts there; a cube's
    counts on the table. A pusher's collision shape is a low disc: it pushes below a cube's middle.
    """
    side, out = INNER + 2 * WALL, INNER + WALL
    spans = [
        (out, 0, WALL, side),
        (-out, 0, WALL, side),
        (0, out, side, WALL),
        (0, -out, side, WALL),
    ]
    half, low = cubes.edge / 2, min(0.03, cubes.edge * 0.4)
    walls = "".join(
        f'<geom name="wall/{k}" type="box" pos="{x} {y} {WALL_HEIGHT / 2}" priority="1"'
        f' size="{a} {b} {WALL_HEIGHT / 2}" friction="0.2"/>'
        for k, (x, y, a, b) in enumerate(spans)
    )
    movers = "".join(
        f'<body pos="0 0 {low}"><joint name="x{k}" type="slide" axis="1 0 0"/>'
        f'<joint name="y{k}" type="slide" axis="0 1 0"/>'
        f'<geom name="pusher{k}" type="cylinder" size="{PUSHER_RADIUS} 0.012"'
        f' mass="{_PUSHER_MASS}" friction="0.3" priority="1"/></body>'
        for k in range(pushers)
    )
    boxes = "".join(
        f'<body pos="0 0 {half}"><freejoint/><geom name="cube{k}" type="box"'
        f' size="{half} {half} {half}" mass="{cubes.mass}" friction="{cubes.friction}"/></body>'
        for k in range(len(cubes.slots))
    )
    kp, kv = _PUSHER_MASS * _STIFFNESS**2, 2 * _PUSHER_MASS * _STIFFNESS
    motors = "".join(
        f'<position joint="{axis}{k}" kp="{kp}" kv="{kv}"'
        f' forcerange="{-_FORCE_LIMIT} {_FORCE_LIMIT}"/>'
        for k in range(pushers)
        for axis in "xy"
    )
    return (
        f'<mujoco><option timestep="{TIMESTEP}" integrator="implicitfast" cone="elliptic"'
        ' impratio="10"/><default><geom solref="0.01 1"/></default><worldbody>'
        '<geom name="table" type="plane" size="1 1 0.1" friction="0.01"/>'
        f"{walls}{movers}{boxes}</worldbody><actuator>{motors}</actuator></mujoco>"
    )
