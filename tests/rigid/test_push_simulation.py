"""The physics of the table against Coulomb, Newton and geometry."""

import numpy as np
import pytest

from acwm_rigid.physics import INNER, PUSHER_RADIUS
from acwm_rigid.push_simulation import MAX_SPEED, Cubes, PushSimulation

GRAVITY = 9.81
AWAY = np.array([[-0.26, -0.26]])


def lay(*xy, yaw=0.0, friction=0.5, mass=0.1, edge=0.08, pusher=AWAY):
    places = np.array(xy, float).reshape(-1, 2)
    slots = tuple(range(len(places)))
    cubes = Cubes(slots, places, np.full(len(places), yaw), edge, mass, friction)
    return PushSimulation(cubes, np.array(pusher, float))


@pytest.mark.parametrize(("speed", "friction"), [(0.6, 0.2), (0.9, 0.5), (1.2, 1.0)])
def test_a_sliding_cube_stops_after_v_squared_over_2_mu_g(speed, friction):
    table = lay((-0.2, 0.0), friction=friction)
    table.data.qvel[2] = speed  # first cube, along x
    table.advance(AWAY, 2.0)
    expected = speed**2 / (2 * friction * GRAVITY)
    assert table.cube_pose[0, 0] + 0.2 == pytest.approx(expected, rel=0.04)
    assert np.abs(table.cube_velocity).max() < 1e-3


def test_a_resting_cube_weighs_m_g_and_stays():
    table = lay((0.1, 0.1), mass=0.2)
    table.advance(AWAY, 1.0)
    assert table.data.qfrc_constraint[4] == pytest.approx(0.2 * GRAVITY, rel=1e-3)
    np.testing.assert_allclose(table.cube_pose[0], [0.1, 0.1, 0.04, 0], atol=2e-4)


def test_the_pusher_reaches_a_near_target_within_a_frame():
    table = lay((0.2, 0.2), pusher=[[0.0, 0.0]])
    table.advance(np.array([[0.03, -0.01]]), 0.1)
    np.testing.assert_allclose(table.pusher_position[0], [0.03, -0.01], atol=2e-3)


def test_the_pusher_travels_far_at_limited_speed_without_overshoot():
    table = lay((0.2, 0.2), pusher=[[-0.2, 0.0]])
    goal, path = np.array([[0.2, 0.0]]), [-0.2]
    for _ in range(12):
        table.advance(goal, 0.1)
        path.append(float(table.pusher_position[0, 0]))
    steps = np.diff(path)
    assert steps.max() <= MAX_SPEED * 0.1 * 1.02
    assert steps.min() > -1e-3
    assert path[-1] == pytest.approx(0.2, abs=1e-3)


def test_a_pushed_cube_moves_as_far_as_the_pusher():
    table = lay((0.0, 0.0), pusher=[[-0.08, 0.0]])
    for x in np.linspace(-0.08, 0.02, 21):  # slowly, so that it does not slide on
        touched = table.advance(np.array([[x, 0.0]]), 0.1)
    assert touched == {(2, 3)}
    # The faces stay together: cube centre = pusher centre + radius + half an edge.
    assert table.cube_pose[0, 0] == pytest.approx(0.02 + PUSHER_RADIUS + 0.04, abs=2e-3)
    table.advance(np.array([[-0.1, 0.0]]), 0.1)
    assert table.advance(np.array([[-0.1, 0.0]]), 0.1) == set()


def test_a_row_of_cubes_touches_in_a_chain_and_stops_at_the_wall():
    table = lay((0.1, 0.0), (0.19, 0.0), pusher=[[0.0, 0.0]])
    touched = set()
    for _ in range(15):
        touched |= table.advance(np.array([[0.26, 0.0]]), 0.1)
    assert {(2, 3), (3, 4), (1, 4)} <= touched
    x = table.cube_pose[:, 0]
    np.testing.assert_allclose(x, [INNER - 0.12, INNER - 0.04], atol=2e-3)
    # Blocked by 0.26 - 0.14 m: it must not be shot off when the way is free again.
    before = table.pusher_position
    table.advance(np.array([[-0.26, 0.0]]), 0.1)
    assert np.linalg.norm(table.pusher_position - before) < MAX_SPEED * 0.1 * 1.2


def test_squeezed_cubes_stay_on_the_table():
    rng = np.random.default_rng(0)
    table = lay((0.0, 0.0), (0.1, 0.1), (0.1, -0.1), pusher=[[-0.2, 0.0], [0.2, 0.0]])
    for _ in range(60):
        table.advance(rng.uniform(-0.26, 0.26, (2, 2)), 0.1)
        pose = table.cube_pose
        assert np.abs(pose[:, 2] - 0.04).max() < 0.005
        assert np.abs(pose[:, :2]).max() < INNER - 0.03
