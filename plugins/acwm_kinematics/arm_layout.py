"""The initial layout of a robot_arm episode: posts, the arm's first pose and goals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_kinematics.arm_planner import Clearance, Joints
from acwm_kinematics.arm_simulation import Post
from acwm_kinematics.physics import REACHED
from acwm_kinematics.states import GOALS
from acwm_sim.geometry import rotations
from acwm_sim.panda import LOWER, UPPER

HOME = np.array([0.0, 0.1, 0.0, -1.9, 0.0, 2.0, np.pi / 4])
"""Joint angles that offsets are relative to: the hand above the table, pointing down."""

OFFSETS = {"central": (-0.95, 0.58), "expanded": (-1.15, 0.88)}
"""Range of each joint's offset from `HOME` in rad, by the factor `workspace` (from the paper)."""

CENTRAL = np.array([[0.30, -0.42, 0.08], [0.66, 0.28, 0.46]])
"""Corners of the box of training goals: metres from the robot's base, z up."""

EXPANDED = np.array([[0.05, -0.66, 0.05], [0.76, 0.62, 0.72]])
"""Corners of the box of out-of-distribution goals; these goals lie outside `CENTRAL`."""

APART = 0.16
"""Least distance in metres of goals from each other and from the hand's first position."""

_GAP = 0.03  # metres between the central goals and the others
_TOLERANCE = 0.012  # rad; keeps an arm that swings beyond its plan within the offsets
_LEVEL = {"central": -0.3, "expanded": 0.1}  # largest cosine between the hand's direction and z
_POSTS = np.array([[0.32, -0.40], [0.64, 0.30]])  # range of post positions, metres
_RADIUS = (0.028, 0.042)
_BETWEEN = 0.17  # least distance of two posts, metres
_IN_THE_WAY = 0.8  # share of posts that are put where the hand would pass
_TRIES = 120


@dataclass(frozen=True)
class Workspace:
    """The range of goals and joint angles for a value of the factor `workspace`."""

    name: str

    @property
    def box(self) -> tuple[Joints, Joints]:
        """Lower and upper bounds of the joint angles, [7] rad each."""
        low, high = OFFSETS[self.name]
        lower, upper = HOME + low + _TOLERANCE, HOME + high - _TOLERANCE
        return np.maximum(lower, LOWER + 0.02), np.minimum(upper, UPPER - 0.02)

    def draw(self, clearance: Clearance, rng: np.random.Generator) -> tuple[Joints, Joints]:
        """Draw a collision-free pose for a goal.

        Returns:
            The joint angles [7] and the grasping point [3].
        """
        while True:
            joints = rng.uniform(*self.box)
            clearance.place(joints)
            point, turn = clearance.panda.hand_pose
            level = rotations(turn[None])[0, 2, 2] < _LEVEL[self.name]
            if level and self.contains(joints, point) and clearance.is_free(joints):
                return joints, point

    def contains(self, joints: Joints, point: NDArray[np.float64]) -> bool:
        """Whether a pose with this grasping point is a goal of this workspace.

        Out of distribution, both the point and some joint must be outside the training range.
        """
        if self.name == "central":
            return _within(point, CENTRAL)
        low, high = OFFSETS["central"]
        offset = joints - HOME
        unusual = bool(((offset < low) | (offset > high)).any())
        outside = not _within(point, CENTRAL + np.array([[-_GAP], [_GAP]]))
        return unusual and outside and _within(point, EXPANDED)


@dataclass(frozen=True)
class ArmLayout:
    """The initial layout of an episode.

    Attributes:
        posts: the obstacles.
        start: [7] initial joint angles.
        poses: [G, 7] joint angles that bring the grasping point to the goals.
        goals: [G, 3] positions of the goals in metres.
        clearance: collision checker for these posts.
    """

    posts: tuple[Post, ...]
    start: Joints
    poses: Joints
    goals: NDArray[np.float64]
    clearance: Clearance


def draw_layout(
    workspace: Workspace, count: int, height: float, rng: np.random.Generator
) -> ArmLayout:
    """Draw posts in the arm's way, a first pose in the training workspace, and goals.

    Args:
        workspace: range of the goals.
        count: number of posts.
        height: largest possible height of a post in metres.
        rng: source of all randomness.
    """
    while True:
        clearance = Clearance(())
        start, hand = Workspace("central").draw(clearance, rng)
        poses, goals = [start], [hand]
        while len(goals) <= GOALS:
            joints, point = workspace.draw(clearance, rng)
            if all(np.linalg.norm(point - other) > APART for other in goals):
                poses.append(joints)
                goals.append(point)
        posts = _draw_posts(clearance, np.array(poses), count, height, rng)
        if len(posts) == count:
            return ArmLayout(posts, start, np.array(poses[1:]), np.array(goals[1:]), clearance)
        clearance.close()


def _draw_posts(
    clearance: Clearance, poses: Joints, count: int, height: float, rng: np.random.Generator
) -> tuple[Post, ...]:
    """Draw alternately round and square posts that do not touch the poses [K, 7] or each other.

    Most stand where the hand would pass on a straight way from one pose to the next. There are
    fewer than `count` if no more fit.
    """
    posts = list[Post]()
    for _ in range(_TRIES):
        if len(posts) == count:
            break
        x, y = rng.uniform(*_POSTS)
        leg, share = int(rng.integers(len(poses) - 1)), rng.uniform(0.3, 0.7)
        if rng.random() < _IN_THE_WAY:
            clearance.place(poses[leg] + share * (poses[leg + 1] - poses[leg]))
            x, y = np.clip(clearance.panda.hand_pose[0][:2], *_POSTS)
        radius, tall = float(rng.uniform(*_RADIUS)), height * float(rng.uniform(0.6, 1.0))
        post = Post((float(x), float(y)), radius, tall, round=len(posts) % 2 == 0)
        apart = all(np.hypot(x - p.place[0], y - p.place[1]) > _BETWEEN for p in posts)
        if apart and clearance.add(post, poses):
            posts.append(post)
    return tuple(posts)


def _within(point: NDArray[np.float64], box: NDArray[np.float64]) -> bool:
    return bool((point >= box[0]).all() and (point <= box[1]).all())


assert 2 * REACHED < APART, "no place may be at two goals"
