"""Collision-free paths in joint space: RRT-connect and shortcuts.

Kuffner and LaValle, "RRT-Connect: An Efficient Approach to Single-Query Path Planning", ICRA 2000.
The shortcuts follow Geraerts and Overmars, "Creating High-quality Paths for Motion Planning",
IJRR 2007.
"""

import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from acwm_kinematics.arm_simulation import SUBSTEP, Post, add_post, add_table
from acwm_sim.bullet import Bullet
from acwm_sim.panda import ARM, Panda

Joints = NDArray[np.float64]

MARGIN = 0.03
"""Distance in metres by which the planner's table and posts are larger than the real ones."""

RESOLUTION = 0.05
"""Largest rotation of a joint in rad between two checked poses. No point of the arm is more than a
metre from a joint's axis, so it cannot pass through `MARGIN` twice in between."""

_SELF_GAP = 0.01  # metres between parts of the arm
_STRIDE = 0.5  # rad; length of a new branch
_BUDGET = 2000  # poses checked for one path


class Clearance:
    """Checks whether the arm collides with table, posts or itself, by PyBullet's collision shapes.

    Args:
        posts: the obstacles.
        margin: distance in metres to keep from table and posts.

    Attributes:
        checked: number of poses checked so far.
    """

    def __init__(self, posts: tuple[Post, ...], margin: float = MARGIN) -> None:
        self.world, self._margin = Bullet(SUBSTEP), margin
        add_table(self.world, margin)
        for post in posts:
            add_post(self.world, post, margin)
        self.panda = Panda(self.world, self_collision=True)
        self._self_gap = _SELF_GAP if margin > 0 else 0.0
        self.checked = 0

    def add(self, post: Post, poses: Joints) -> bool:
        """Add a post unless the arm touches it in one of the poses [K, 7]; True if it was added."""
        body = add_post(self.world, post, self._margin)
        fits = all(self.is_free(pose) for pose in poses)
        if not fits:
            self.world.removeBody(body)
        return fits

    def place(self, joints: Joints) -> None:
        """Move the arm to a pose, [7] rad."""
        for joint, angle in zip(ARM, joints.tolist(), strict=True):
            self.world.resetJointState(self.panda.body, joint, angle)

    def is_free(self, joints: Joints) -> bool:
        """Whether a pose is free of collisions."""
        self.checked += 1
        self.place(joints)
        self.world.performCollisionDetection()
        body = self.panda.body
        for point in self.world.getContactPoints(body):
            if point[8] <= (self._self_gap if point[1] == point[2] else 0.0):
                return False
        return True

    def is_edge_free(self, start: Joints, end: Joints, resolution: float = RESOLUTION) -> bool:
        """Whether the straight line between two poses is free; `start` itself is not checked."""
        count = max(1, int(np.ceil(np.abs(end - start).max() / resolution)))
        order = np.argsort([_bits(k) for k in range(1, count + 1)], kind="stable")
        return all(self.is_free(start + (end - start) * ((k + 1) / count)) for k in order)

    def is_path_free(self, path: ArrayLike, resolution: float = RESOLUTION) -> bool:
        """Whether a polyline of poses [K, 7] is free; the first pose is not checked."""
        points = np.asarray(path, np.float64)
        return all(self.is_edge_free(a, b, resolution) for a, b in itertools.pairwise(points))

    def close(self) -> None:
        """Free the world."""
        self.world.close()


def plan(
    clearance: Clearance,
    start: Joints,
    goal: Joints,
    box: tuple[Joints, Joints],
    rng: np.random.Generator,
) -> Joints | None:
    """Plan a short collision-free path.

    Args:
        clearance: the collision checker.
        start: [7] joint angles, assumed to be free.
        goal: [7] joint angles.
        box: lower and upper bounds of the joint angles, [7] each.
        rng: source of all randomness.

    Returns:
        A polyline [K, 7] from start to goal, or None if none was found within a fixed number of
        checked poses, which takes a fraction of a second.
    """
    if clearance.is_edge_free(start, goal):
        return np.array([start, goal])
    if not clearance.is_free(goal):
        return None
    path = _connect(clearance, start, goal, box, rng)
    return None if path is None else _shortened(clearance, path, rng)


class _Tree:
    """A tree of poses, each with its parent."""

    def __init__(self, root: Joints) -> None:
        self.poses, self.parents = root[None].copy(), [-1]

    def nearest(self, pose: Joints) -> int:
        return int(np.argmin(((self.poses - pose) ** 2).sum(axis=1)))

    def grow(self, parent: int, pose: Joints) -> int:
        self.poses = np.vstack([self.poses, pose])
        self.parents.append(parent)
        return len(self.parents) - 1

    def branch(self, node: int) -> list[Joints]:
        """The poses from a node back to the root."""
        poses: list[Joints] = []
        while node >= 0:
            poses.append(self.poses[node])
            node = self.parents[node]
        return poses


def _connect(
    clearance: Clearance,
    start: Joints,
    goal: Joints,
    box: tuple[Joints, Joints],
    rng: np.random.Generator,
) -> Joints | None:
    """RRT-connect: two trees alternately grow towards a random pose and towards each other."""
    trees, last = (_Tree(start), _Tree(goal)), clearance.checked + _BUDGET
    turn = 0
    while clearance.checked < last:
        near, far = trees[turn], trees[1 - turn]
        tip = _extend(clearance, near, rng.uniform(*box))
        if tip is not None:
            met = _reach(clearance, far, near.poses[tip])
            if met is not None:
                halves = [near.branch(tip)[::-1], far.branch(met)[1:]]
                path = np.array(halves[0] + halves[1])
                return path if turn == 0 else path[::-1].copy()
        turn = 1 - turn
    return None


def _extend(clearance: Clearance, tree: _Tree, towards: Joints) -> int | None:
    """Grow a tree by one branch; returns the new node, or None if it is blocked."""
    parent = tree.nearest(towards)
    here = tree.poses[parent]
    gap = towards - here
    pose = here + gap * min(1.0, _STRIDE / float(np.linalg.norm(gap)))
    return tree.grow(parent, pose) if clearance.is_edge_free(here, pose) else None


def _reach(clearance: Clearance, tree: _Tree, towards: Joints) -> int | None:
    """Grow a tree until it reaches `towards` or is blocked; returns the node if it gets there."""
    while (node := _extend(clearance, tree, towards)) is not None:
        if np.allclose(tree.poses[node], towards, atol=1e-9):
            return node
    return None


def _shortened(clearance: Clearance, path: Joints, rng: np.random.Generator) -> Joints:
    """Replace parts of a path between two random points by straight lines where these are free."""
    for _ in range(24):
        if len(path) == 2:
            break
        lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
        marks = np.concatenate([[0.0], np.cumsum(lengths)])
        low, high = np.sort(rng.uniform(0.0, marks[-1], 2))
        first, last = (int(np.searchsorted(marks, s, "right")) - 1 for s in (low, high))
        if first == last:
            continue
        a, b = (
            path[k] + (path[k + 1] - path[k]) * ((s - marks[k]) / lengths[k])
            for k, s in ((first, low), (last, high))
        )
        if clearance.is_edge_free(a, b):
            path = np.vstack([path[: first + 1], a, b, path[last + 1 :]])
    return _without_straight_corners(clearance, path)


def _without_straight_corners(clearance: Clearance, path: Joints) -> Joints:
    """Drop corners that a straight line can skip without collision."""
    kept = [path[0]]
    k = 0
    while k < len(path) - 1:
        last = len(path) - 1
        while last > k + 1 and not clearance.is_edge_free(path[k], path[last]):
            last -= 1
        kept.append(path[last])
        k = last
    return np.array(kept)


def _bits(k: int) -> float:
    """Van der Corput sequence: checking poses in this order finds collisions early."""
    value, half = 0.0, 0.5
    while k:
        value, half, k = value + half * (k & 1), half / 2, k >> 1
    return value
