"""The physics of stack_cube: a Panda whose hand follows a target, two cubes and a floor."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_sim.bullet import Bullet, pybullet
from acwm_sim.geometry import rotations
from acwm_sim.panda import FINGERS, HAND, HOME, OPEN, Panda

TIMESTEP = 1 / 240
"""Seconds of one physics step."""

RED, GREEN = 0, 1
"""Row indices of the cubes in arrays."""

ARM_ID, GRIPPER_ID, RED_ID, GREEN_ID = 1, 2, 3, 4
"""Instance ids; 0 is the floor."""

WORKSPACE = np.array([[0.25, -0.35, 0.012], [0.72, 0.35, 0.60]])
"""Lowest and highest position of the hand's target, metres."""

LEAD = 0.06
"""Largest lead in metres of the target over the hand, so that a blocked hand does not wind up."""

MAX_TILT, MAX_YAW = 0.7, 1.7
"""Limits in radians of the hand's tilt and of its rotation about the vertical; rotations beyond
them are ignored."""

DOWN = np.array([1.0, 0.0, 0.0, 0.0])
"""Orientation (x, y, z, w) of a hand that points down with its fingers side by side along y."""

_CHECKS = 6  # contact checks per frame
_FINGER_FRICTION = 1.5
_GRIP = 20.0  # newtons per finger
_TIPS = (0.011, 0.027, 0.0075)  # metres by which fingertips extend from the point between them
_CLEARANCE = 0.004  # metres


@dataclass(frozen=True)
class Start:
    """The initial state of an episode.

    Attributes:
        cubes: [2, 3] centres of the red and the green cube in metres and their yaw in radians, as
            rows (x, y, yaw).
        hand: [3] position of the hand in metres.
        edge: length of a cube's edge in metres.
        mass: mass of a cube in kg.
        friction: Coulomb coefficient of a cube on the floor and on the other cube.
    """

    cubes: NDArray[np.float64]
    hand: NDArray[np.float64]
    edge: float
    mass: float
    friction: float


class StackSimulation:
    """A Panda, a red and a green cube on a floor.

    Args:
        start: the initial state.

    Attributes:
        start: the initial state.
        world: the PyBullet world.
        panda: the robot.
        edge: length of a cube's edge in metres.
        position: [3] target of the grasping point.
        rotation: [4] target orientation of the hand, (x, y, z, w).
        opening: target distance of each finger from the middle, metres.
    """

    def __init__(self, start: Start) -> None:
        self.start, self.world, self.edge = start, Bullet(TIMESTEP), start.edge
        self._floor = _floor(self.world)
        self.panda = Panda(self.world)
        self._cubes = [_cube(self.world, row, start) for row in start.cubes]
        for finger in FINGERS:
            self.world.changeDynamics(self.panda.body, finger, lateralFriction=_FINGER_FRICTION)
        self.position, self.rotation, self.opening = start.hand.copy(), DOWN.copy(), OPEN
        self._joints = self._reach(HOME)

    def close(self) -> None:
        """Free the world."""
        self.world.close()

    def advance(self, action: NDArray[np.float64], seconds: float) -> set[tuple[int, int]]:
        """Move the hand's target by `action` and simulate; see `StackCube` for the action.

        Returns:
            Pairs of instance ids that touched.
        """
        hand, _ = self.panda.hand_pose
        rotation = turned(self.rotation, action[3:6])
        if _in_reach(rotation):
            self.rotation = rotation
        self.opening = float(np.clip(self.opening + OPEN / 2 * action[6], 0.0, OPEN))
        wanted = np.clip(self.position + action[:3], hand - LEAD, hand + LEAD)
        self.position = np.clip(wanted, *WORKSPACE)
        self.position[2] = max(self.position[2], self._lowest())
        before, self._joints = self._joints, self._solve()
        self.panda.grip(self.opening, force=_GRIP)
        steps, touched = round(seconds / TIMESTEP), set[tuple[int, int]]()
        for step in range(1, steps + 1):
            self.panda.drive(before + (self._joints - before) * min(1.0, 1.25 * step / steps))
            self.world.stepSimulation()
            if step % (steps // _CHECKS) == 0:
                touched |= self.touching()
        return touched

    def put(self, which: int, center: NDArray[np.float64], yaw: float) -> None:
        """Place cube `RED` or `GREEN` at `center` [3], at rest."""
        turn = [0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)]
        self.world.resetBasePositionAndOrientation(self._cubes[which], center.tolist(), turn)

    def touching(self) -> set[tuple[int, int]]:
        """Pairs of instance ids in contact, the smaller id first."""
        pairs = set[tuple[int, int]]()
        for contact in self.world.getContactPoints():
            if contact[8] > 1e-3:  # more than this many metres apart
                continue
            first, second = self._instance(contact[1], contact[3]), self._instance(*contact[2:5:2])
            if first != second:
                pairs.add((min(first, second), max(first, second)))
        return pairs

    def cube_body(self, which: int) -> int:
        """The PyBullet body id of cube `RED` or `GREEN`."""
        return self._cubes[which]

    @property
    def cube_pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """[2, 3] centres and [2, 4] orientations (x, y, z, w) of the cubes."""
        poses = [self.world.getBasePositionAndOrientation(cube) for cube in self._cubes]
        return np.array([p[0] for p in poses]), np.array([p[1] for p in poses])

    @property
    def cube_velocity(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """[2, 3] velocities of the centres in m/s and [2, 3] angular velocities in rad/s."""
        velocities = [self.world.getBaseVelocity(cube) for cube in self._cubes]
        return np.array([v[0] for v in velocities]), np.array([v[1] for v in velocities])

    @property
    def stacked(self) -> bool:
        """Whether the red cube rests on the green one and nothing else holds it."""
        (red, green), _ = self.cube_pose
        above = abs(red[2] - green[2] - self.edge) < 0.1 * self.edge
        centred = np.linalg.norm(red[:2] - green[:2]) < 0.5 * self.edge
        return bool(above and centred and (GRIPPER_ID, RED_ID) not in self.touching())

    @property
    def poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """World positions [13, 3] and rotations [13, 3, 3] of the Panda's parts, then the cubes."""
        places, turns = self.panda.poses
        centers, quaternions = self.cube_pose
        return np.concatenate([places, centers]), np.concatenate([turns, rotations(quaternions)])

    def _lowest(self) -> float:
        """Height of the grasping point at which the fingertips just clear the floor."""
        across, along, ahead = rotations([self.rotation])[0, 2]
        wide, deep, long = _TIPS
        reach = abs(across) * wide + abs(along) * (deep + self.opening) - ahead * long
        return reach + _CLEARANCE

    def _solve(self) -> NDArray[np.float64]:
        return self.panda.solve(self.position, self.rotation)

    def _reach(self, joints: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move the arm to its target without simulating time."""
        for _ in range(20):
            for joint, angle in enumerate(joints):
                self.world.resetJointState(self.panda.body, joint, angle)
            joints = self._solve()
        return joints

    def _instance(self, body: int, link: int) -> int:
        if body == self._floor:
            return 0
        if body == self.panda.body:
            return GRIPPER_ID if link >= HAND else ARM_ID
        return RED_ID if body == self._cubes[RED] else GREEN_ID


def _in_reach(quaternion: NDArray[np.float64]) -> bool:
    """Whether the arm can hold its hand in this orientation anywhere in the workspace."""
    turn = rotations([quaternion])[0]
    yaw = np.arctan2(turn[1, 0], turn[0, 0])
    return bool(-turn[2, 2] >= np.cos(MAX_TILT) and abs(yaw) <= MAX_YAW)


def turned(quaternion: NDArray[np.float64], rotation: ArrayLike) -> NDArray[np.float64]:
    """Rotate an orientation [4] (x, y, z, w) by a rotation vector [3] in the world, radians."""
    vector = np.asarray(rotation, np.float64)
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 1e-12 else np.zeros(3)
    x, y, z = axis * np.sin(angle / 2)
    w, (a, b, c, d) = np.cos(angle / 2), quaternion
    product = np.array(
        [
            w * a + x * d + y * c - z * b,
            w * b - x * c + y * d + z * a,
            w * c + x * b - y * a + z * d,
            w * d - x * a - y * b - z * c,
        ]
    )
    return product / np.linalg.norm(product)


def rotation_between(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray:
    """The rotation vector [3] in the world, radians, from one orientation [4] to another."""
    w, v = second[3], second[:3]
    real = w * first[3] + v @ first[:3]
    vector = first[3] * v - w * first[:3] - np.cross(v, first[:3])
    if real < 0:  # take the shorter rotation
        real, vector = -real, -vector
    length = float(np.linalg.norm(vector))
    return vector * (2 * np.arctan2(length, real) / length if length > 1e-12 else 0.0)


def _floor(world: Bullet) -> int:
    floor = world.createMultiBody(0, world.createCollisionShape(pybullet.GEOM_PLANE))
    world.changeDynamics(floor, -1, lateralFriction=1.0)
    return floor


def _cube(world: Bullet, row: NDArray[np.float64], start: Start) -> int:
    """A cube on the floor. Bullet multiplies the friction of the two bodies in a contact."""
    half = start.edge / 2
    shape = world.createCollisionShape(pybullet.GEOM_BOX, halfExtents=[half] * 3)
    place = [row[0], row[1], half]
    turn = [0.0, 0.0, np.sin(row[2] / 2), np.cos(row[2] / 2)]
    cube = world.createMultiBody(start.mass, shape, -1, place, turn)
    world.changeDynamics(
        cube,
        -1,
        lateralFriction=start.friction,
        spinningFriction=0.002,
        linearDamping=0,
        angularDamping=0,
    )
    return cube
