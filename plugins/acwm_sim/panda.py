"""The Franka Panda: its physics in PyBullet, its kinematics, and its looks in a `Scene`.

The model is `franka_panda/panda.urdf` of the PyBullet wheel (Apache-2.0). The arm's base stands at
the world's origin; lengths are in metres, angles in radians.

Its meshes are in `panda.npz`, made by `acwm_sim.decimate_panda` from the visual meshes of
`pybullet_data/franka_panda`, which Franka Emika GmbH released under the Apache License 2.0; changed
by that decimation. The kinematics go by Denavit–Hartenberg parameters in Craig's convention, as
Franka publishes them.
"""

import functools
from pathlib import Path

import numpy as np
import pybullet_data
from numpy.typing import ArrayLike, NDArray

from acwm_sim.bullet import Bullet, pybullet
from acwm_sim.geometry import rotations
from acwm_sim.meshes import Mesh
from acwm_sim.scene import Scene

ARM = tuple(range(7))
"""Numbers of the arm's joints."""

FINGERS = (9, 10)
"""Numbers of the fingers' joints, and of their links."""

HAND, GRASP = 8, 11
"""Links: the hand, and the point between the fingertips that grasps."""

LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""Limits of the arm's joints, from Franka's data sheet."""

MAX_VELOCITY = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
"""Velocity limits of the arm's joints in rad/s, from Franka's data sheet."""

MAX_TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
"""Torque limits of the arm's joints in N·m, from Franka's data sheet."""

HOME = np.array([0.0, -0.4, 0.0, -2.2, 0.0, 1.9, np.pi / 4])
"""Joint angles of a ready pose: the hand before the base, pointing down."""

OPEN = 0.04
"""Metres that each finger is from the middle when the gripper is open."""

_URDF = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"

# (link of the URDF, mesh); a finger's mesh serves both, turned round for the right one.
_LOOKS = (
    (-1, "link0"),
    *((link, f"link{link + 1}") for link in range(7)),
    (HAND, "hand"),
    (FINGERS[0], "finger"),
    (FINGERS[1], "finger"),
)
_TURNED = np.diag([-1.0, -1.0, 1.0])


ASSET = Path(__file__).with_name("panda.npz")

MESHES = (*(f"link{k}" for k in range(8)), "hand", "finger")
"""Names of the meshes, each in the frame of its link."""

VERTEX_UNIT = 1e-5
"""Metres that a step of the stored vertices stands for."""


@functools.cache
def load_mesh(name: str) -> Mesh:
    """One of `MESHES`, with display colours."""
    with np.load(ASSET) as arrays:
        vertices, normals, colors, triangles = (
            arrays[f"{name}.{part}"] for part in ("vertices", "normals", "colors", "triangles")
        )
    return Mesh(
        vertices.astype(np.float32) * np.float32(VERTEX_UNIT),
        normals.astype(np.float32) / np.float32(127),
        triangles.astype(np.int32),
        colors.astype(np.float32) / np.float32(255),
    )


class Panda:
    """A Panda in a physics world.

    Args:
        world: where to put it.
        joints: [7] angles at first.
        opening: distance of each finger from the middle at first, 0 to `OPEN`.
        self_collision: whether links that no joint connects stop each other.

    Attributes:
        world: the world.
        body: its number there.
    """

    def __init__(
        self,
        world: Bullet,
        joints: ArrayLike = HOME,
        opening: float = OPEN,
        *,
        self_collision: bool = False,
    ) -> None:
        self.world = world
        flags = pybullet.URDF_IGNORE_VISUAL_SHAPES  # they take longer to load than an episode
        if self_collision:
            flags |= pybullet.URDF_USE_SELF_COLLISION
            flags |= pybullet.URDF_USE_SELF_COLLISION_EXCLUDE_PARENT
        self.body: int = world.loadURDF(str(_URDF), useFixedBase=True, flags=flags)
        if self_collision:  # but the hand is bolted to the last link, and their shapes overlap
            world.setCollisionFilterPair(self.body, self.body, ARM[-1], HAND, 0)
        for joint, angle in zip(ARM, np.asarray(joints, float), strict=True):
            world.resetJointState(self.body, joint, angle)
        for finger in FINGERS:
            world.resetJointState(self.body, finger, opening)
            world.setJointMotorControl2(self.body, finger, pybullet.VELOCITY_CONTROL, force=0)

    @property
    def joints(self) -> NDArray[np.float64]:
        """[7] angles of the arm."""
        return np.array([s[0] for s in self.world.getJointStates(self.body, ARM)])

    @property
    def joint_velocities(self) -> NDArray[np.float64]:
        """[7] rad/s."""
        return np.array([s[1] for s in self.world.getJointStates(self.body, ARM)])

    @property
    def opening(self) -> float:
        """Distance between the fingertips, 0 to 2 `OPEN`."""
        return float(sum(s[0] for s in self.world.getJointStates(self.body, FINGERS)))

    @property
    def hand_pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position [3] of the grasping point, and its orientation as a quaternion (x, y, z, w)."""
        state = self.world.getLinkState(self.body, GRASP, computeForwardKinematics=True)
        return np.array(state[4]), np.array(state[5])

    @property
    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions [11, 3] and rotations [11, 3, 3] of the parts that `add_panda` adds."""
        states = self.world.getLinkStates(self.body, range(12), computeForwardKinematics=True)
        places, turns = np.zeros((len(_LOOKS), 3)), np.zeros((len(_LOOKS), 3, 3))
        turns[0] = np.eye(3)
        links = [link for link, _ in _LOOKS[1:]]
        places[1:] = [states[link][4] for link in links]
        turns[1:] = rotations([states[link][5] for link in links])
        turns[-1] = turns[-1] @ _TURNED
        return places, turns

    def solve(self, position: ArrayLike, quaternion: ArrayLike) -> NDArray[np.float64]:
        """Inverse kinematics: [7] angles near the present ones that bring the grasping point there.

        Args:
            position: [3].
            quaternion: [4], (x, y, z, w).
        """
        rotation = rotations(np.asarray(quaternion, float)[None])[0]
        return inverse(np.asarray(position, float), rotation, self.joints, (LOWER, UPPER), HOME)

    def drive(self, joints: ArrayLike, *, gain: float = 0.25) -> None:
        """Let the arm's motors pull towards [7] angles, within their torques."""
        self.world.setJointMotorControlArray(
            self.body,
            ARM,
            pybullet.POSITION_CONTROL,
            targetPositions=np.asarray(joints, float).tolist(),
            forces=MAX_TORQUE.tolist(),
            positionGains=[gain] * len(ARM),
        )

    def grip(self, opening: float, *, force: float = 40.0, speed: float = 0.2) -> None:
        """Let the fingers move to `opening` from the middle each, with at most `force` newtons."""
        for finger in FINGERS:
            self.world.setJointMotorControl2(
                self.body,
                finger,
                pybullet.POSITION_CONTROL,
                targetPosition=opening,
                force=force,
                maxVelocity=speed,
            )


def add_panda(scene: Scene, arm_instance: int, hand_instance: int) -> int:
    """Add the parts of a Panda to a scene; their poses are `Panda.poses`, in this order.

    Args:
        scene: where to add them.
        arm_instance: id of the arm in the mask.
        hand_instance: id of the hand and its fingers.

    Returns:
        The number of parts.
    """
    for link, name in _LOOKS:
        instance = hand_instance if link >= HAND else arm_instance
        scene.add_mesh(load_mesh(name), instance=instance, gloss=0.25)
    return len(_LOOKS)


# Kinematics ----------------------------------------------------------------------------------

_A = np.array([0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088])
_D = np.array([0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0])
_TWISTS = (0, -1, 1, 1, -1, 1, 1)  # quarter turns about x
_COS, _SIN = [int(k == 0) for k in _TWISTS], list(_TWISTS)
_OFFSETS = np.array([_A, -np.array(_SIN) * _D, np.array(_COS) * _D]).T
_GRASP = 0.107 + 0.105  # metres from the last joint over the flange to between the fingertips
_HALF = np.sqrt(0.5)
_HAND = np.array([[_HALF, _HALF, 0.0], [-_HALF, _HALF, 0.0], [0.0, 0.0, 1.0]])  # −45° about z

_DAMPING = 1e-4  # keeps steps short near singular poses
_PULL = 0.15  # share of the way to the rest pose that the first step takes, if the hand stays
_MAX_STEP = 0.3  # radians per step
_STEPS, _ENOUGH = 30, 1e-5  # at most; metres and radians that may be missing


def forward(joints: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Position [3] and rotation [3, 3] of the grasping point, and its Jacobian [6, 7].

    The Jacobian's rows are the velocity and the angular velocity, in the world.
    """
    sines, cosines = np.sin(joints).tolist(), np.cos(joints).tolist()
    place, turn = np.zeros(3), np.eye(3)
    places, axes = np.empty((7, 3)), np.empty((7, 3))
    for k in range(7):
        s, c, sa, ca = sines[k], cosines[k], _SIN[k], _COS[k]
        place = place + turn @ _OFFSETS[k]
        turn = turn @ np.array([[c, -s, 0.0], [s * ca, c * ca, -sa], [s * sa, c * sa, ca]])
        places[k], axes[k] = place, turn[:, 2]
    place = place + _GRASP * turn[:, 2]
    return place, turn @ _HAND, np.vstack([_cross(axes, place - places).T, axes.T])


def inverse(
    position: NDArray,
    rotation: NDArray,
    start: NDArray,
    limits: tuple[NDArray, NDArray],
    rest: NDArray,
) -> NDArray[np.float64]:
    """Joint angles [7] near `start` that bring the hand there, or as near as their limits allow.

    Damped least squares (Wampler 1986); what freedom is left draws the arm towards `rest`.

    Args:
        position: [3], metres.
        rotation: [3, 3].
        start: [7], radians.
        limits: least and greatest angles.
        rest: [7].
    """
    joints = np.asarray(start, np.float64)
    for number in range(_STEPS):
        place, turn, jacobian = forward(joints)
        turning = 0.5 * _cross(turn.T, rotation.T).sum(0)
        missing = np.concatenate([position - place, turning])
        if np.abs(missing).max() < _ENOUGH:
            break
        square = jacobian @ jacobian.T + _DAMPING * np.eye(6)
        back = (rest - joints) * (_PULL if number == 0 else 0.0)
        step = back + jacobian.T @ np.linalg.solve(square, missing - jacobian @ back)
        step *= min(1.0, _MAX_STEP / np.abs(step).max())
        joints = np.clip(joints + step, *limits)
    return joints


def _cross(a: NDArray, b: NDArray) -> NDArray:
    """Cross products of rows [N, 3]; NumPy's own is several times slower for so few."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
