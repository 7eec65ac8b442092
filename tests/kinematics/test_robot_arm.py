"""robot_arm as a user meets it: actions, ground truth, policy, splits, reproducibility."""

import numpy as np
import pytest

from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_kinematics.arm_drawing import ARM_ID, FIRST_POST_ID, GRIPPER_ID, MAX_POSTS, MET, WAITING
from acwm_kinematics.arm_layout import CENTRAL, HOME, OFFSETS
from acwm_kinematics.arm_planner import Clearance
from acwm_kinematics.arm_policy import Reacher
from acwm_kinematics.arm_timing import MAX_SPEED
from acwm_kinematics.robot_arm import RobotArm
from acwm_sim.bullet import pybullet
from acwm_sim.panda import LOWER, MAX_VELOCITY, UPPER
from tests.sim.playing import start, undrawn

pytestmark = pytest.mark.ci

EPISODES = {"train": 24, "ood_test": 12}
FIRST_GOAL_ID = FIRST_POST_ID + MAX_POSTS
SPLITS = {"train": "central", "ood_test": "expanded"}


@pytest.fixture(scope="module")
def env():
    return RobotArm(size=64)


@pytest.fixture(scope="module")
def unseen():
    return undrawn(RobotArm)(size=16)


@pytest.fixture(scope="module")
def episodes(unseen):
    """Episodes of the policy by split."""
    return {
        split: [simulate(unseen, EpisodeSpec("robot_arm", split, k)) for k in range(count)]
        for split, count in EPISODES.items()
    }


@pytest.fixture(scope="module")
def drawn(env):
    """A few episodes with their pictures."""
    return [simulate(env, EpisodeSpec("robot_arm", "train", k)) for k in range(2)]


def run(env, actions, index=3, **factors):
    return simulate(env, EpisodeSpec("robot_arm", "train", index, factors=factors), actions)


@pytest.mark.parametrize("split", SPLITS)
def test_every_planned_motion_is_free_of_collisions(unseen, split):
    """Between the frames too, with the real sizes of things and much finer than the planner."""
    bent = count = 0
    for index in range(8):
        start(unseen, split, index)
        rng = EpisodeSpec("robot_arm", split, index).rng("policy")
        reacher = Reacher(unseen.simulation, unseen.layout, unseen._workspace, 0.1, rng)
        for _ in range(63):
            unseen.step(np.clip(reacher.next_turn(), -0.12, 0.12).astype(np.float32))
        exact = Clearance(unseen.layout.posts, margin=0.0)
        for path, motion in reacher.plans:
            whole = np.vstack([path[0], motion])
            assert exact.is_path_free(path, resolution=0.01)
            assert exact.is_path_free(whole, resolution=0.01)
            bent += len(path) > 2
        count += len(reacher.plans)
        assert reacher.failures == 0
        exact.close()
    assert count > 24
    assert bent > 0  # posts were in the way


def test_executed_motions_touch_nothing_but_goals(episodes):
    for split in SPLITS:
        for episode in episodes[split]:
            pairs = {(a, b) for _, a, b in episode.contacts.tolist()}
            assert all(a == GRIPPER_ID and b >= FIRST_GOAL_ID for a, b in pairs)


def test_executed_motions_follow_the_targets_within_limits(episodes):
    for split in SPLITS:
        for episode in episodes[split]:
            joints, target = episode.states["joint_position"], episode.states["joint_target"]
            np.testing.assert_allclose(joints, target, atol=2e-3)
            assert ((joints > LOWER) & (joints < UPPER)).all()
            speed = np.abs(episode.states["joint_velocity"])
            assert (speed < MAX_VELOCITY).all()
            assert speed.max() < 1.02 * MAX_SPEED
            displacement = np.cumsum(episode.actions[:-1], axis=0)
            np.testing.assert_allclose(joints[1:] - joints[0], displacement, atol=2e-3)


def test_joint_offsets_stay_in_the_range_of_the_split(episodes):
    for split, name in SPLITS.items():
        low, high = OFFSETS[name]
        offsets = np.concatenate([e.states["joint_position"] for e in episodes[split]]) - HOME
        assert offsets.min() >= low
        assert offsets.max() <= high
        assert offsets.min() < low + 0.06  # and use it
        assert offsets.max() > high - 0.06
    low, high = OFFSETS["central"]
    moves = [e.states["joint_position"] - HOME for e in episodes["ood_test"]]
    beyond = [(offsets < low) | (offsets > high) for offsets in moves]
    assert np.mean([some.any() for some in beyond]) == 1.0
    assert np.mean(np.concatenate(beyond).any(axis=1)) > 0.4


def test_goals_lie_inside_or_outside_the_central_workspace(episodes):
    for split, name in SPLITS.items():
        for episode in episodes[split]:
            goals = episode.states["goal_position"][0]
            inside = ((goals >= CENTRAL[0]) & (goals <= CENTRAL[1])).all(axis=1)
            assert inside.all() if name == "central" else not inside.any()
            assert episode.ood_label == (None if name == "central" else "workspace=expanded")


def test_the_policy_reaches_goals_covers_the_workspace_and_rests(episodes):
    for split, least in (("train", 2.2), ("ood_test", 1.9)):
        some = episodes[split]
        reached = [e.states["goal_reached"][-1].sum() for e in some]
        assert np.mean(reached) > least
        assert min(reached) >= 1
        still = np.concatenate([np.abs(e.actions[:-1]).max(axis=1) < 1e-3 for e in some])
        assert 0.04 < still.mean() < 0.3
        joints = np.concatenate([e.states["joint_position"] for e in some])
        assert (joints.std(axis=0) > 0.2).all()  # each joint takes part
        assert len({e.actions.tobytes() for e in some}) == len(some)
    hands = np.concatenate([e.states["hand_position"] for e in episodes["train"]])
    cells = np.floor((hands - CENTRAL[0]) / (CENTRAL[1] - CENTRAL[0]) * 3)
    visited = {tuple(c) for c in cells.astype(int).tolist() if min(c) >= 0 and max(c) <= 2}
    assert len(visited) >= 24  # of 27


def test_states_agree_with_each_other(episodes):
    for episode in episodes["train"][:8]:
        states = episode.states
        np.testing.assert_allclose(np.linalg.norm(states["hand_quaternion"], axis=1), 1, atol=1e-5)
        w, x, y, z = states["hand_quaternion"].T
        down = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)], axis=1)
        tip = states["link_position"][:, 7] + 0.105 * down
        np.testing.assert_allclose(tip, states["hand_position"], atol=1e-4)
        near = np.linalg.norm(states["goal_position"] - states["hand_position"][:, None], axis=2)
        seen = np.maximum.accumulate(near < 0.02, axis=0)
        assert (states["goal_reached"] >= seen).all()
        late = states["goal_reached"].astype(bool) & ~seen  # reached between two frames
        assert late.mean() < 0.2
        moved = np.linalg.norm(np.diff(states["hand_position"], axis=0), axis=1)
        speed = np.linalg.norm(states["hand_velocity"], axis=1)
        assert abs(moved.sum() - 0.1 * speed.sum()) < 0.1 * moved.sum()
        assert 0.01 < moved.mean() < 0.06
        assert moved.max() < 0.15


def test_masks_show_everything_where_the_state_says(env, drawn):
    shown = 0
    for episode in drawn:
        states, camera = episode.states, env.drawing.scene.camera
        present = np.flatnonzero(states["obstacle_present"][0])
        assert {1, ARM_ID, GRIPPER_ID} <= set(np.unique(episode.masks[0]))
        for t in (0, 20, 40, 63):
            places = [(FIRST_GOAL_ID + k, p) for k, p in enumerate(states["goal_position"][t])]
            places += [(FIRST_POST_ID + k, states["obstacle_position"][t, k]) for k in present]
            for instance, place in places:
                rows, columns = np.nonzero(episode.masks[t] == instance)
                x, y, _ = camera.project(place, 64, 64)
                if len(rows) > 2:
                    assert abs(columns.mean() + 0.5 - x) < 3
                    assert abs(rows.mean() + 0.5 - y) < 6
                    shown += 1
            absent = [FIRST_POST_ID + k for k in range(MAX_POSTS) if k not in present]
            assert not np.isin(episode.masks[t], absent).any()
    assert shown > 24


def test_goals_turn_green_when_they_are_reached(drawn):
    seen = {False: [], True: []}
    for episode in drawn:
        for t in range(0, 64, 4):
            for k, reached in enumerate(episode.states["goal_reached"][t]):
                pixels = episode.video[t][episode.masks[t] == FIRST_GOAL_ID + k].astype(float)
                if len(pixels) > 4:
                    seen[bool(reached)].append(pixels.mean(0))
    for reached, paint in ((False, WAITING), (True, MET)):
        mean = np.mean(seen[reached], axis=0)
        assert np.argmax(mean) == np.argmax(paint)


def test_lagging_servos_and_weak_motors_move_otherwise(unseen):
    actions = np.zeros((64, 7), np.float32)
    actions[:8, 0] = 0.08
    actions[:8, 1] = -0.05
    usual = run(unseen, actions).states["joint_position"]
    late = run(unseen, actions, servo_lag=0.15).states["joint_position"]
    assert 0.05 < (usual - late)[8, 0] < 0.16  # at 0.8 rad/s for long, 0.15 s behind
    np.testing.assert_allclose(late[-1], usual[-1], atol=2e-3)
    weak = run(unseen, actions, motor_strength=0.3).states["joint_position"]
    assert np.abs(weak - usual).max() > 0.05


def test_closing_frees_the_worlds(unseen):
    unseen.close()
    others = worlds()
    for index in range(3):
        start(unseen, index=index)
        assert worlds() == others + 2  # where it moves, and where its planner looks for collisions
    for _ in range(2):
        unseen.close()
        assert worlds() == others
    start(unseen)


def worlds():
    """How many physics worlds there are in this process."""
    return sum(pybullet.isConnected(client) for client in range(1024))
