"""The physics of robot_arm: a Panda among posts on a table, with joints driven by servos."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_kinematics.physics import REACHED
from acwm_sim.bullet import Bullet, pybullet
from acwm_sim.panda import ARM, GRASP, HAND, LOWER, MAX_TORQUE, MAX_VELOCITY, OPEN, UPPER, Panda

SUBSTEP = 1 / 240
"""Seconds of one physics step."""

TABLE = (0.54, 0.60, 0.03)
"""Half sizes of the table top in metres; its centre is at `TABLE_CENTER`, its surface at z = 0."""

TABLE_CENTER = (0.27, 0.0, -TABLE[2])

MAX_STEP = 0.12
"""Largest rotation of a joint by one action in rad."""

WINDUP = 0.35
"""Largest lead in rad of a joint's target over the joint: it waits for a blocked arm."""

THROWN = 6.0
"""Largest joint speed in rad/s that contacts may cause against the servo. (With a lower limit the
arm sinks into what it hits: joints must give way.)"""

TOUCHING = 5e-4
"""Gap in metres below which PyBullet's contact points count as contacts."""

_GAIN = 0.3  # share of the position error that a servo corrects in a substep
_SLACK = (MAX_VELOCITY - 10 * MAX_STEP) * SUBSTEP / _GAIN  # keeps within the speed limits


@dataclass(frozen=True)
class Post:
    """An upright obstacle fixed to the table.

    Attributes:
        place: (x, y) in metres.
        radius: radius of a round post, or half the width of a square one, in metres.
        height: metres.
        round: whether it is a cylinder.
    """

    place: tuple[float, float]
    radius: float
    height: float
    round: bool


@dataclass(frozen=True)
class Servos:
    """How well the joints follow their targets.

    Attributes:
        lag: time constant of the servos in seconds; 0 follows without delay.
        strength: their torque limits relative to Franka's data sheet.
    """

    lag: float = 0.0
    strength: float = 1.0


def add_table(world: Bullet, margin: float = 0.0) -> int:
    """Add the table to a world, enlarged by `margin` metres; returns the body id."""
    half = np.array(TABLE) + margin
    shape = world.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half.tolist())
    return world.createMultiBody(0, shape, -1, TABLE_CENTER)


def add_post(world: Bullet, post: Post, margin: float = 0.0) -> int:
    """Add a post to a world, enlarged by `margin` metres; returns the body id."""
    radius, height = post.radius + margin, post.height + margin
    if post.round:
        kind, sizes = pybullet.GEOM_CYLINDER, {"radius": radius, "height": height}
    else:
        kind, sizes = pybullet.GEOM_BOX, {"halfExtents": [radius, radius, height / 2]}
    shape = world.createCollisionShape(kind, **sizes)
    return world.createMultiBody(0, shape, -1, [*post.place, height / 2])


class ArmSimulation:
    """A Panda, a table, posts, and goals: points in the air for the hand to visit.

    Args:
        joints: [7] initial joint angles, rad.
        posts: the obstacles.
        goals: [G, 3] positions of the goals in metres.
        servos: how the joints follow their targets.
        instances: ids for contacts: table, arm, hand, then the posts, then the goals.

    Attributes:
        target: [7] target angles of the servos, rad.
        reached: [G] whether the grasping point has been at each goal.
    """

    def __init__(
        self,
        joints: ArrayLike,
        posts: tuple[Post, ...],
        goals: NDArray[np.float64],
        servos: Servos,
        instances: tuple[int, ...],
    ) -> None:
        self.world = Bullet(SUBSTEP)
        self.posts, self.goals, self.servos = posts, goals, servos
        bodies = [add_table(self.world), *(add_post(self.world, post) for post in posts)]
        self.panda = Panda(self.world, joints, self_collision=True)
        self.panda.grip(OPEN)
        self.world.changeDynamics(self.panda.body, -1, maxJointVelocity=THROWN)
        table, self._arm_id, self._hand_id, *others = instances
        self._ids = dict(zip(bodies, (table, *others[: len(posts)]), strict=True))
        self._goal_ids = others[len(posts) :]
        self.target = np.array(joints, np.float64)
        self._reference = self.target.copy()
        self.reached = np.zeros(len(goals), bool)
        self._visit()

    @property
    def grasp(self) -> NDArray[np.float64]:
        """[3] position of the grasping point, metres."""
        return np.array(self.panda.hand_pose[0])

    @property
    def link_positions(self) -> NDArray[np.float64]:
        """[8, 3] origins of the frames of link 1 to link 7 and of the hand, metres."""
        links = [*ARM, HAND]
        states = self.world.getLinkStates(self.panda.body, links, computeForwardKinematics=True)
        return np.array([state[4] for state in states])

    @property
    def grasp_velocity(self) -> NDArray[np.float64]:
        """[3] velocity of the grasping point, m/s."""
        state = self.world.getLinkState(self.panda.body, GRASP, computeLinkVelocity=True)
        return np.array(state[6])

    def advance(self, turn: NDArray[np.float64], seconds: float) -> set[tuple[int, int]]:
        """Move the targets by `turn` ([7], rad), evenly over some seconds, and let the arm follow.

        Targets stay within the joint limits, and at most `WINDUP` ahead of a joint.

        Returns:
            Pairs of ids that touched; a goal counts as touched if the grasping point is at it.
        """
        start, here = self.target, self.panda.joints
        end = np.clip(start + turn, here - WINDUP, here + WINDUP)
        self.target = np.clip(end, LOWER, UPPER)
        touched = set[tuple[int, int]]()
        substeps = round(seconds / SUBSTEP)
        for k in range(1, substeps + 1):
            self._servo(start + (self.target - start) * (k / substeps))
            self.world.stepSimulation()
            touched |= self._touching()
            if k % 4 == 0:
                touched |= self._visit()
        return touched

    def close(self) -> None:
        """Free the world."""
        self.world.close()

    def _servo(self, command: NDArray[np.float64]) -> None:
        """Drive the joints towards a reference that lags behind the command by `servos.lag`.

        The motors get the speed of the reference, plus a correction of the position error.
        """
        lag = self.servos.lag
        answer = 1.0 if lag == 0 else 1.0 - np.exp(-SUBSTEP / lag)
        change, before = answer * (command - self._reference), self._reference
        self._reference = before + change
        here = self.panda.joints
        self.world.setJointMotorControlArray(
            self.panda.body,
            ARM,
            pybullet.POSITION_CONTROL,
            targetPositions=np.clip(before, here - _SLACK, here + _SLACK).tolist(),
            targetVelocities=(change / SUBSTEP).tolist(),
            positionGains=[_GAIN] * len(ARM),
            velocityGains=[1.0] * len(ARM),
            forces=(self.servos.strength * MAX_TORQUE).tolist(),
        )

    def _touching(self) -> set[tuple[int, int]]:
        """Current contacts of the arm, as pairs of ids."""
        pairs = set[tuple[int, int]]()
        for point in self.world.getContactPoints(self.panda.body):
            if point[8] < TOUCHING:
                one, other = (self._id(point[1 + k], point[3 + k]) for k in (0, 1))
                if one != other:  # links of the arm share one id
                    pairs.add((one, other))
        return pairs

    def _id(self, body: int, link: int) -> int:
        if body == self.panda.body:
            return self._hand_id if link >= HAND else self._arm_id
        return self._ids[body]

    def _visit(self) -> set[tuple[int, int]]:
        """Mark and return the goals at which the grasping point is now."""
        here = np.flatnonzero(np.linalg.norm(self.goals - self.grasp, axis=1) < REACHED)
        self.reached[here] = True
        return {(self._hand_id, self._goal_ids[k]) for k in here}
