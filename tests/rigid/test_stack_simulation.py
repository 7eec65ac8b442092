"""The physics of stacking against mechanics: falling, sliding, grasping, following a target."""

import numpy as np
import pytest

from acwm_rigid.stack_simulation import (
    OPEN,
    RED,
    WORKSPACE,
    StackSimulation,
    Start,
    rotation_between,
    turned,
)
from acwm_sim.bullet import GRAVITY
from acwm_sim.panda import LOWER, UPPER

HALF = 0.025


@pytest.fixture
def made():
    worlds = []

    def make(red=(0.5, 0.12, 0.0), hand=(0.45, 0.0, 0.3), friction=0.9, mass=0.08):
        cubes = np.array([red, (0.5, -0.12, 0.0)])
        worlds.append(StackSimulation(Start(cubes, np.array(hand), 2 * HALF, mass, friction)))
        return worlds[-1]

    yield make
    for world in worlds:
        world.close()


def act(world, frames, xyz=(0, 0, 0), turn=(0, 0, 0), gripper=0.0):
    for _ in range(frames):
        world.advance(np.array([*xyz, *turn, gripper], float), 0.1)


@pytest.mark.parametrize(("speed", "friction"), [(0.8, 0.9), (0.8, 0.45), (0.5, 0.3)])
def test_a_sliding_cube_stops_after_v_squared_over_2_mu_g(made, speed, friction):
    stack = made(red=(0.5, -0.45, 0.0), friction=friction)
    act(stack, 2)
    cube, before = stack.cube_body(RED), stack.cube_pose[0][RED].copy()
    stack.world.resetBaseVelocity(cube, [-speed, 0, 0], [0, 0, 0])
    for _ in range(240):
        stack.world.stepSimulation()
    slid = before[0] - stack.cube_pose[0][RED, 0]
    assert slid == pytest.approx(speed**2 / (2 * friction * GRAVITY), rel=0.04)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("step", [0.02, -0.02])
def test_the_hand_moves_along_the_axis_by_that_many_metres(made, axis, step):
    stack = made()
    before = stack.panda.hand_pose[0]
    act(stack, 3, xyz=step * np.eye(3)[axis])
    act(stack, 2)
    np.testing.assert_allclose(
        stack.panda.hand_pose[0] - before, 3 * step * np.eye(3)[axis], atol=2e-3
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_hand_turns_about_the_axis_by_that_many_radians(made, axis):
    stack = made()
    before = stack.panda.hand_pose[1]
    act(stack, 2, turn=0.15 * np.eye(3)[axis])
    act(stack, 2)
    expected = turned(before, 0.3 * np.eye(3)[axis])
    after = stack.panda.hand_pose[1]
    angle = 2 * np.arccos(min(1.0, abs(expected @ after)))
    assert angle < 0.02
    assert 2 * np.arccos(min(1.0, abs(before @ after))) == pytest.approx(0.3, abs=0.02)


def test_turning_follows_the_rotation_of_scipy():
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(0)
    for _ in range(20):
        q, v = Rotation.random(rng=rng), rng.normal(size=3)
        expected = (Rotation.from_rotvec(v) * q).as_quat()
        found = turned(q.as_quat(), v)
        assert abs(expected @ found) == pytest.approx(1, abs=1e-9)


def test_a_rotation_between_orientations_turns_one_into_the_other():
    rng = np.random.default_rng(1)
    for _ in range(20):
        first, second = rng.normal(size=(2, 4))
        first, second = first / np.linalg.norm(first), second / np.linalg.norm(second)
        vector = rotation_between(first, second)
        assert np.linalg.norm(vector) <= np.pi + 1e-9
        assert abs(turned(first, vector) @ second) == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(rotation_between(first, first), 0, atol=1e-12)


def test_the_gripper_closes_and_opens_by_half_its_way_per_unit(made):
    stack = made()
    assert stack.panda.opening == pytest.approx(2 * OPEN, abs=1e-3)
    for command, opening in ((-1.0, OPEN), (0.0, OPEN), (-0.5, OPEN / 2), (1.0, 1.5 * OPEN)):
        act(stack, 1, gripper=command)
        act(stack, 4)
        assert stack.panda.opening == pytest.approx(opening, abs=1e-3)


def test_nothing_moves_when_the_action_is_zero(made):
    stack = made()
    hand, cubes = stack.panda.hand_pose[0], stack.cube_pose[0]
    act(stack, 10)
    np.testing.assert_allclose(stack.panda.hand_pose[0], hand, atol=1e-4)
    np.testing.assert_allclose(stack.cube_pose[0], cubes, atol=1e-3)


def test_the_gripper_holds_a_lifted_cube_and_its_fingers_stay_outside(made):
    stack = made(red=(0.5, 0.0, 0.0), hand=(0.5, 0.0, 0.1))
    act(stack, 3, xyz=(0, 0, -0.025))
    act(stack, 4, gripper=-1)
    assert stack.panda.opening == pytest.approx(2 * HALF, abs=0.002)
    act(stack, 5, xyz=(0, 0, 0.03))
    act(stack, 10)
    assert stack.cube_pose[0][RED, 2] == pytest.approx(HALF + 0.15, abs=0.005)
    assert (2, 3) in stack.touching()
    assert (0, 3) not in stack.touching()
    deepest = min(contact[8] for contact in stack.world.getContactPoints())
    assert deepest > -0.002


def test_a_blocked_hand_and_wild_targets_stay_within_bounds(made):
    stack = made()
    rng = np.random.default_rng(1)
    act(stack, 12, xyz=(0, 0, -0.06))
    assert stack.panda.hand_pose[0][2] > 0
    for _ in range(40):
        act(stack, 1, xyz=rng.uniform(-0.06, 0.06, 3), turn=rng.uniform(-0.25, 0.25, 3))
        joints = stack.panda.joints
        assert ((joints > LOWER - 0.02) & (joints < UPPER + 0.02)).all()
        assert (stack.position >= WORKSPACE[0]).all()
        assert (stack.position <= WORKSPACE[1] + [0, 0, 0.1]).all()
        assert np.isfinite(stack.cube_pose[0]).all()
