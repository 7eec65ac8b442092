"""The Franka Panda: its physics in PyBullet, its kinematics, and its meshes in a `Scene`.

The model is `franka_panda/panda.urdf` of the PyBullet wheel (Apache-2.0). The base of the arm is at
the world's origin; lengths are in metres, angles in radians.

Its meshes are in `panda.npz`, made by `acwm_sim.decimate_panda` from the visual meshes of
`pybullet_data/franka_panda`, which Franka Emika GmbH released under the Apache License 2.0; changed
by that decimation. The kinematics use the Denavit–Hartenberg parameters in Craig's convention that
Franka publishes.
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
"""Indices of the arm's joints."""

FINGERS = (9, 10)
"""Indices of the finger joints, and of the finger links."""

HAND, GRASP = 8, 11
"""Links: the hand, and the grasping point between the fingertips."""

LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""Limits of the arm's joints in radians, from Franka's data sheet."""

MAX_VELOCITY = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
"""Velocity limits of the arm's joints in rad/s, from Franka's data sheet."""

MAX_TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
"""Torque limits of the arm's joints in N·m, from Franka's data sheet."""

HOME = np.array([0.0, -0.4, 0.0, -2.2, 0.0, 1.9, np.pi / 4])
"""Joint angles of a ready pose: the hand in front of the base, pointing down."""

OPEN = 0.04
"""Distance in metres of each finger from the middle when the gripper is open."""

_URDF = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"

# (link of the URDF, mesh); both fingers use one mesh, rotated by 180° for the right one.
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
"""Unit of the stored integer vertices in metres."""


@functools.cache
def load_mesh(name: str) -> Mesh:
    """Load one of `MESHES`, with display colours."""
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
        world: the physics world to put it in.
        joints: [7] initial joint angles.
        opening: initial distance of each finger from the middle, 0 to `OPEN`.
        self_collision: whether links that share no joint collide with each other.

    Attributes:
        world: the physics world.
        body: its body id in that world.
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
        if self_collision:  # except the hand and the last link: they are fixed and overlap
            world.setCollisionFilterPair(self.body, self.body, ARM[-1], HAND, 0)
        for joint, angle in zip(ARM, np.asarray(joints, float), strict=True):
            world.resetJointState(self.body, joint, angle)
        for finger in FINGERS:
            world.resetJointState(self.body, finger, opening)
            world.setJointMotorControl2(self.body, finger, pybullet.VELOCITY_CONTROL, force=0)

    @property
    def joints(self) -> NDArray[np.float64]:
        """[7] joint angles of the arm in radians."""
        return np.array([s[0] for s in self.world.getJointStates(self.body, ARM)])

    @property
    def joint_velocities(self) -> NDArray[np.float64]:
        """[7] joint velocities of the arm in rad/s."""
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
        """Inverse kinematics: [7] joint angles near the current ones that reach a pose.

        Args:
            position: [3], of the grasping point.
            quaternion: [4], (x, y, z, w), its orientation.
        """
        rotation = rotations(np.asarray(quaternion, float)[None])[0]
        return inverse(np.asarray(position, float), rotation, self.joints, (LOWER, UPPER), HOME)

    def drive(self, joints: ArrayLike, *, gain: float = 0.25) -> None:
        """Drive the arm's motors towards [7] joint angles, within their torque limits."""
        self.world.setJointMotorControlArray(
            self.body,
            ARM,
            pybullet.POSITION_CONTROL,
            targetPositions=np.asarray(joints, float).tolist(),
            forces=MAX_TORQUE.tolist(),
            positionGains=[gain] * len(ARM),
        )

    def grip(self, opening: float, *, force: float = 40.0, speed: float = 0.2) -> None:
        """Move each finger to `opening` from the middle, with at most `force` newtons."""
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
    """Add the parts of a Panda to a scene, in the order of `Panda.poses`.

    Args:
        scene: the scene to add them to.
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
_GRASP = 0.107 + 0.105  # metres: last joint to flange, flange to the point between the fingertips
_HALF = np.sqrt(0.5)
_HAND = np.array([[_HALF, _HALF, 0.0], [-_HALF, _HALF, 0.0], [0.0, 0.0, 1.0]])  # −45° about z

_DAMPING = 1e-4  # keeps steps short near singular poses
_PULL = 0.15  # share of the way to the rest pose in the first step, where the hand is not affected
_MAX_STEP = 0.3  # radians per step
_STEPS, _ENOUGH = 30, 1e-5  # most steps; tolerance in metres and radians


def forward(joints: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Position [3] and rotation [3, 3] of the grasping point, and its Jacobian [6, 7].

    The Jacobian's rows are the linear and the angular velocity in the world frame.
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
    """Joint angles [7] near `start` that reach a pose, or come as near as their limits allow.

    Damped least squares (Wampler 1986); the remaining freedom pulls the arm towards `rest`.

    Args:
        position: [3], metres, of the grasping point.
        rotation: [3, 3], its orientation.
        start: [7], radians.
        limits: smallest and largest angles.
        rest: [7], radians.
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
    """Cross products of rows [N, 3]; NumPy's own is several times slower for so few rows."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)
