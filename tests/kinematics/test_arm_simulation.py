"""The physics of robot_arm against what mechanics says: kinematics, servos, gravity, contacts."""

import numpy as np
import pytest

from acwm_kinematics.arm_layout import HOME
from acwm_kinematics.arm_simulation import MAX_STEP, WINDUP, ArmSimulation, Post, Servos
from acwm_sim.panda import ARM, LOWER, MAX_TORQUE, MAX_VELOCITY, UPPER

TABLE, ARM_ID, HAND_ID, POST, GOAL = 1, 2, 3, 4, 8
SOFT = 0.0699
"""Franka's hard limits lie this far beyond the soft ones; a contact can push a joint there."""


def world(joints=HOME, posts=(), goals=((0.0, 0.0, 2.0),), servos=None):
    goal_ids = range(GOAL, GOAL + len(goals))
    ids = (TABLE, ARM_ID, HAND_ID, *range(POST, POST + len(posts)), *goal_ids)
    return ArmSimulation(joints, tuple(posts), np.array(goals), servos or Servos(), ids)


@pytest.mark.parametrize("joint", ARM)
def test_an_action_turns_its_joint_by_that_angle_within_the_frame(joint):
    for sign in (1, -1):
        arm, turn = world(), np.zeros(7)
        turn[joint] = 0.05 * sign
        arm.advance(turn, 0.1)
        np.testing.assert_allclose(arm.panda.joints - HOME, turn, atol=5e-4)
        arm.advance(np.zeros(7), 0.1)
        np.testing.assert_allclose(arm.panda.joints - HOME, turn, atol=1e-4)
        assert np.abs(arm.panda.joint_velocities).max() < 0.01
        arm.close()


def gravity_torques(arm):
    """What each motor must hold, N·m: the moments of the weights beyond its axis."""
    body, physics = arm.panda.body, arm.world
    states = physics.getLinkStates(body, range(12), computeForwardKinematics=True)
    masses = [physics.getDynamicsInfo(body, link)[0] for link in range(12)]
    torques = []
    for joint in ARM:
        frame = np.reshape(physics.getMatrixFromQuaternion(states[joint][5]), (3, 3))
        origin, axis = np.array(states[joint][4]), frame[:, 2]
        moments = [
            np.cross(np.array(states[link][0]) - origin, [0, 0, -9.81 * masses[link]]) @ axis
            for link in range(joint, 12)
        ]
        torques.append(sum(moments))
    return np.array(torques)


@pytest.mark.parametrize(("share", "holds"), [(1.1, True), (0.9, False)])
def test_motors_hold_the_arm_exactly_if_they_are_stronger_than_gravity(share, holds):
    joints = HOME + np.array([0, 0.3, 0, 0.5, 0, 0, 0])
    full = world(joints)
    needed = (np.abs(gravity_torques(full)) / MAX_TORQUE).max()
    full.close()
    assert 0.3 < needed < 0.9  # Franka's motors hold it, a third of them would not
    arm = world(joints, servos=Servos(strength=share * needed))
    for _ in range(5):
        arm.advance(np.zeros(7), 0.1)
    sag = np.abs(arm.panda.joints - joints).max()
    assert sag < 1e-3 if holds else sag > 0.02
    arm.close()


def test_servos_lag_as_a_first_order_system_does():
    lag, turn, seconds = 0.15, 0.1, 0.1
    arm = world(servos=Servos(lag=lag))
    arm.advance(np.eye(7)[0] * turn, seconds)
    behind = turn * lag / seconds * (1 - np.exp(-seconds / lag))  # after a ramp
    seen = [arm.panda.joints[0]]
    for _ in range(4):
        arm.advance(np.zeros(7), seconds)
        seen.append(arm.panda.joints[0])
    expected = turn - behind * np.exp(-seconds * np.arange(5) / lag)
    np.testing.assert_allclose(seen, expected, atol=2e-3)  # a physics step is a 36th of the lag
    arm.close()


def penetration(arm):
    points = arm.world.getContactPoints(arm.panda.body)
    return max([0.0, *(-p[8] for p in points)])


@pytest.mark.parametrize(
    ("joint", "sign", "post"),
    [(1, 1, None), (0, 1, Post((0.50, 0.25), 0.04, 0.5, round=True)),
     (0, -1, Post((0.50, -0.25), 0.04, 0.5, round=False))],
)  # fmt: skip
def test_it_stops_at_the_table_and_at_posts(joint, sign, post):
    arm = world(posts=(post,) if post else ())
    thing, events = POST if post else TABLE, []
    for _ in range(25):
        events.append(arm.advance(np.eye(7)[joint] * 0.08 * sign, 0.1))
        assert penetration(arm) < 0.004
    assert events[0] == set()  # it starts apart from everything
    assert any(thing in pair and {ARM_ID, HAND_ID} & set(pair) for pair in events[-1])
    assert sign * (arm.panda.joints - HOME)[joint] < 1.2  # two radians were asked for
    ahead = np.abs(arm.target - arm.panda.joints)[joint]
    assert 0.1 < ahead < WINDUP + MAX_STEP
    back = [arm.advance(np.eye(7)[joint] * -0.08 * sign, 0.1) for _ in range(8)]
    assert back[-1] == set()  # it comes off again
    arm.close()


def test_whatever_the_actions_it_stays_within_limits_and_out_of_things():
    posts = (Post((0.45, -0.2), 0.035, 0.25, round=True), Post((0.5, 0.2), 0.03, 0.2, round=False))
    touched, deep = set(), []
    for seed in range(5):
        rng, arm = np.random.default_rng(seed), world(posts=posts)
        turns = np.repeat(rng.choice([-MAX_STEP, MAX_STEP], (3, 7)), 12, axis=0)
        for turn in turns:
            pairs = arm.advance(turn, 0.1)
            touched |= {*pairs}
            deep.append(penetration(arm))
            joints = arm.panda.joints
            assert ((joints > LOWER - SOFT - 0.01) & (joints < UPPER + SOFT + 0.01)).all()
            assert ((arm.target >= LOWER) & (arm.target <= UPPER)).all()
            if not pairs and not arm.world.getContactPoints(arm.panda.body):
                assert (np.abs(arm.panda.joint_velocities) < 1.05 * MAX_VELOCITY).all()
        arm.close()
    assert len(touched) > 3
    assert max(deep) < 0.03  # at full speed the hand goes 15 mm between two steps
    assert np.mean(np.array(deep) > 0.005) < 0.05


def test_joints_stop_at_their_limits():
    for joint, sign in ((6, 1), (6, -1), (4, 1), (2, -1)):
        arm = world()
        for _ in range(40):
            arm.advance(np.eye(7)[joint] * MAX_STEP * sign, 0.1)
        limit = (UPPER if sign > 0 else LOWER)[joint]
        assert arm.panda.joints[joint] == pytest.approx(limit, abs=2e-3)
        arm.close()


def test_the_arm_stops_at_itself():
    arm = world()
    events = set()
    for turn in [[0, -0.1, 0, -0.11, 0, -0.11, 0]] * 14 + [[0, 0.02, 0, -0.1, 0, -0.12, 0]] * 10:
        events |= arm.advance(np.array(turn), 0.1)
        links = arm.world.getContactPoints(arm.panda.body, arm.panda.body)
        assert max([0.0, *(-p[8] for p in links)]) < 0.008
    assert (ARM_ID, HAND_ID) in {(min(p), max(p)) for p in events}
    arm.close()


def test_a_goal_is_reached_where_the_grasping_point_is_and_stays_reached():
    here = world()
    (x, y, z), ahead = here.grasp, np.eye(7)[0] * 0.1
    here.close()
    arm = world(goals=((x, y + 0.1, z), (x, y, z + 0.3)))
    assert not arm.reached.any()
    seen = [arm.advance(ahead, 0.1) for _ in range(4)]
    assert {pair for pairs in seen for pair in pairs} == {(HAND_ID, GOAL)}
    assert seen[0] == set()
    assert seen[-1] == set()
    assert arm.reached.tolist() == [True, False]
    arm.close()
