"""The physics of push_cube: sliding cubes, walls, and pushers that follow a target."""

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_rigid.physics import INNER, PUSHER_RADIUS
from acwm_sim.mujoco import mujoco

WALL = 0.015
"""Half thickness of a wall, metres."""

WALL_HEIGHT = 0.03

MAX_SPEED = 0.65
"""Speed limit of the point that a pusher follows, m/s."""

TIMESTEP = 1 / 300
"""Seconds. With larger steps sliding cubes hover by millimetres, an artefact of the solver."""

WALL_ID, FIRST_BODY_ID = 1, 2
"""Instance ids: 0 is the table, 1 the walls, then come the pushers, then the cubes."""

# The actuators are critically damped: kv = 2 √(kp · mass). At 80 rad/s a pusher lags its
# reference by 25 ms, a quarter of a frame.
_PUSHER_MASS, _STIFFNESS = 0.1, 80.0
_FORCE_LIMIT = 4.0  # newtons; the friction of a cube is half a newton
_LEAD = 0.02  # metres by which the reference may be ahead of the pusher when a frame begins


@dataclass(frozen=True)
class Cubes:
    """The cubes of an episode.

    Attributes:
        slots: indices of the cubes in the episode, increasing.
        xy: [n, 2] starting centres in metres.
        yaw: [n] starting angles in radians.
        edge: length of an edge in metres.
        mass: mass of one cube in kg.
        friction: Coulomb coefficient between a cube and the table, and between cubes.
    """

    slots: tuple[int, ...]
    xy: NDArray[np.float64]
    yaw: NDArray[np.float64]
    edge: float
    mass: float
    friction: float


class PushSimulation:
    """The simulation of one episode. It is newly built, so nothing is left of other episodes.

    Args:
        cubes: the cubes on the table.
        pushers: [P, 2] starting positions in metres.
    """

    def __init__(self, cubes: Cubes, pushers: NDArray[np.float64]) -> None:
        self.cubes = cubes
        self.model = mujoco.MjModel.from_xml_string(_xml(cubes, len(pushers)))
        self.data = mujoco.MjData(self.model)
        self._pushers = len(pushers)
        self._instance = _instances(self.model, cubes, len(pushers))
        self.reference = np.array(pushers, np.float64)
        self.data.qpos[: 2 * self._pushers] = self.reference.ravel()
        places = self.data.qpos[2 * self._pushers :].reshape(-1, 4)
        places[:, :2], places[:, 2], places[:, 3] = cubes.xy, cubes.edge / 2, cubes.yaw
        self.data.ctrl[:] = self.reference.ravel()
        mujoco.mj_forward(self.model, self.data)

    def advance(self, target: NDArray[np.float64], seconds: float) -> set[tuple[int, int]]:
        """Move the pushers towards `target` ([P, 2], metres) for some seconds.

        Returns:
            The pairs of instance ids that touched at any time meanwhile, without the table.
        """
        meetings: set[bytes] = set()  # lists of touching geoms; most steps repeat the previous one
        # The reference waits for a blocked pusher, so that it does not shoot off once it is free.
        position = self.pusher_position
        lead = self.reference - position
        length = np.maximum(np.linalg.norm(lead, axis=1, keepdims=True), 1e-9)
        self.reference = position + lead * np.minimum(1.0, _LEAD / length)
        gap = target - self.reference
        reach = np.maximum(np.linalg.norm(gap, axis=1, keepdims=True), 1e-9)
        steps = np.arange(1, round(seconds / TIMESTEP) + 1)[:, None, None]
        path = self.reference + gap * np.minimum(1.0, steps * (MAX_SPEED * TIMESTEP) / reach)
        self.reference = path[-1]
        model, data, step = self.model, self.data, mujoco.mj_step
        control = data.ctrl
        for point in path.reshape(len(path), -1):
            control[:] = point
            step(model, data)
            meetings.add(data.contact.geom.tobytes())
        geoms = np.frombuffer(b"".join(meetings), np.int32).reshape(-1, 2)
        return {(a, b) for a, b in self._instance[geoms].tolist() if min(a, b) > 0}

    def snapshot(self) -> Callable[[], None]:
        """A function that returns to this moment."""
        data, reference = copy.copy(self.data), self.reference

        def back() -> None:
            mujoco.mj_copyData(self.data, self.model, data)
            self.reference = reference

        return back

    @property
    def touching(self) -> bool:
        """Whether any two bodies, other than the table, touch now."""
        return bool((self._instance[self.data.contact.geom] > 0).all(1).any())

    @property
    def pusher_position(self) -> NDArray[np.float64]:
        """Positions of the pushers, [P, 2] metres."""
        return self.data.qpos[: 2 * self._pushers].reshape(-1, 2).copy()

    @property
    def pusher_velocity(self) -> NDArray[np.float64]:
        """Velocities of the pushers, [P, 2] m/s."""
        return self.data.qvel[: 2 * self._pushers].reshape(-1, 2).copy()

    @property
    def cube_pose(self) -> NDArray[np.float64]:
        """[n, 4]: centre in metres, and unwrapped yaw in radians."""
        return self.data.qpos[2 * self._pushers :].reshape(-1, 4).copy()

    @property
    def cube_velocity(self) -> NDArray[np.float64]:
        """[n, 4]: velocity of the centre (m/s) and of the yaw (rad/s)."""
        return self.data.qvel[2 * self._pushers :].reshape(-1, 4).copy()

    @property
    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """World positions [P + n, 3] and rotations [P + n, 3, 3] of pushers, then cubes."""
        mujoco.mj_kinematics(self.model, self.data)
        return self.data.xpos[1:].copy(), self.data.xmat[1:].reshape(-1, 3, 3).copy()


def _instances(model: Any, cubes: Cubes, pushers: int) -> NDArray[np.int64]:
    """Instance id of every geom; the names of geoms start with what they belong to."""
    first_cube = FIRST_BODY_ID + pushers
    ids = {"table": 0, "wall": WALL_ID}
    ids |= {f"pusher{k}": FIRST_BODY_ID + k for k in range(pushers)}
    ids |= {f"cube{k}": first_cube + slot for k, slot in enumerate(cubes.slots)}
    return np.array([ids[model.geom(g).name.split("/")[0]] for g in range(model.ngeom)])


def _xml(cubes: Cubes, pushers: int) -> str:
    """The MuJoCo model as XML."""
    movers = "".join(_pusher_xml(k) for k in range(pushers))
    boxes = "".join(_cube_xml(k, cubes) for k in range(len(cubes.slots)))
    kp, kv = _PUSHER_MASS * _STIFFNESS**2, 2 * _PUSHER_MASS * _STIFFNESS
    motors = "".join(
        f'<position joint="{axis}{k}" kp="{kp}" kv="{kv}"'
        f' forcerange="{-_FORCE_LIMIT} {_FORCE_LIMIT}"/>'
        for k in range(pushers)
        for axis in "xy"
    )
    return (
        f'<mujoco><option timestep="{TIMESTEP}" integrator="implicitfast" cone="elliptic"/>'
        '<default><geom solref="0.01 1"/></default><worldbody>'
        '<geom name="table" type="plane" size="1 1 0.1" friction="0.01"/>'
        f"{_walls_xml()}{movers}{boxes}</worldbody><actuator>{motors}</actuator></mujoco>"
    )


def _walls_xml() -> str:
    """Walls, much thicker and taller than drawn, so that deep contacts push out horizontally.

    Pushers and walls have priority in contacts, so their friction is used there.
    """
    half = 0.1
    out, side = INNER + half, INNER + 2 * half
    spans = [
        (out, 0, half, side),
        (-out, 0, half, side),
        (0, out, side, half),
        (0, -out, side, half),
    ]
    return "".join(
        f'<geom name="wall/{k}" type="box" pos="{x} {y} {half}" size="{a} {b} {half}"'
        ' friction="0.2" priority="1"/>'
        for k, (x, y, a, b) in enumerate(spans)
    )


def _pusher_xml(k: int) -> str:
    """A cylinder that slides above the table, about as tall as a wall for the same reason."""
    return (
        f'<body pos="0 0 0.1"><joint name="x{k}" type="slide" axis="1 0 0"/>'
        f'<joint name="y{k}" type="slide" axis="0 1 0"/>'
        f'<geom name="pusher{k}" type="cylinder" size="{PUSHER_RADIUS} 0.09"'
        f' mass="{_PUSHER_MASS}" friction="0.3" priority="1"/></body>'
    )


def _cube_xml(k: int, cubes: Cubes) -> str:
    """A box that slides and rotates on the table, held down only by its weight.

    It cannot tip over or rise by more than a centimetre; otherwise, when squeezed between pushers
    or against a wall, it would sooner or later be flicked off the table.
    """
    half = cubes.edge / 2
    return (
        '<body><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 1 0"/>'
        f'<joint type="slide" axis="0 0 1" limited="true" range="-1 {half + 0.008}"/>'
        f'<joint type="hinge" axis="0 0 1"/><geom name="cube{k}" type="box"'
        f' size="{half} {half} {half}" mass="{cubes.mass}" friction="{cubes.friction}"/></body>'
    )
