"""The physics of sand: falling, sliding, resting, heaps, and a board that nothing passes."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from acwm_particle.kernels.sand_step import GRAVITY, GROUND_FRICTION
from acwm_particle.sand import CLEARANCE, FRAME, HIGH, LOW, Pose, Sand
from acwm_particle.sand_layout import LAYOUTS, pour
from acwm_particle.sand_policy import heading

R = 0.0105
HALF = np.array([0.01, 0.15, 0.075])


def sand(grains, friction=0.55):
    return Sand(np.atleast_2d(grains), R, friction, HALF)


def put(world, x, y, z=0.0, yaw=0.0):
    world.put_board(Pose(np.array([x, y, z]), heading(yaw)))


def overlap(grains):
    """The deepest overlap of two grains, in diameters."""
    return 1 - cKDTree(grains).query(grains, k=2)[0][:, 1].min() / (2 * R)


def in_board(world):
    """How deep the deepest grain is in the board, in radii."""
    local = (world.grains - world.board.position) @ world.board.rotation
    outside = np.abs(local) - world.half
    distance = np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(1), 0)
    return (R - distance).max() / R


@pytest.fixture(scope="module")
def heap():
    world = sand(pour(1500, R, "heap", np.random.default_rng(0)))
    world.settle(20)
    return world


def test_a_grain_falls_by_half_g_t_squared_until_it_is_as_fast_as_it_may_be():
    world = sand([0, 0, 1.0])
    world.wait()  # 0.08 s later it would reach the limit of 0.8 radii per substep
    dt, steps = FRAME / 10, 8
    position, speed = 1.0, 0.0
    for step in range(10):
        speed = min(speed + GRAVITY * dt, 0.8 * R / dt)
        position -= speed * dt
        if step == steps - 1:
            analytic = GRAVITY * (steps * dt) ** 2 / 2
            assert 1 - position == pytest.approx(analytic, rel=0.13)  # symplectic Euler
    assert world.grains[0, 2] == pytest.approx(position, rel=5e-3)


@pytest.mark.parametrize("speed", [0.3, 0.6])
def test_a_sliding_grain_stops_after_v_squared_over_2_mu_g(speed):
    world = sand([0, 0, R])
    world.velocities[0, 0] = speed
    for _ in range(3):
        world.wait()
    expected = speed**2 / (2 * GROUND_FRICTION * GRAVITY)
    assert world.grains[0, 0] == pytest.approx(expected, abs=0.5 * speed * FRAME / 10 + 1e-3)
    assert not world.velocities.any()


def test_a_settled_heap_stays_where_it_is(heap):
    world = sand(heap.grains.copy())
    for _ in range(20):
        world.wait()
    moved = np.linalg.norm(world.grains - heap.grains, axis=1) / R
    assert moved.mean() < 0.08
    assert np.percentile(moved, 95) < 0.5


@pytest.mark.parametrize("layout", LAYOUTS)
def test_settled_sand_is_whole_above_ground_and_hardly_overlaps(layout):
    world = sand(pour(1200, R, layout, np.random.default_rng(1)))
    assert len(world.grains) == 1200
    world.settle(20)
    assert np.isfinite(world.grains).all()
    assert world.grains[:, 2].min() >= R * 0.999
    assert overlap(world.grains) < 0.2
    near = cKDTree(world.grains).query(world.grains, k=2)[0][:, 1] / (2 * R)
    assert np.median(near) > 0.95
    assert np.abs(world.grains[:, :2]).max() < 0.6


def test_energy_never_grows_while_sand_settles():
    world = sand(pour(800, R, "heap", np.random.default_rng(2)))
    energies = []
    for _ in range(12):
        world.wait()
        kinetic = (world.velocities**2).sum() / 2
        energies.append(kinetic + GRAVITY * world.grains[:, 2].sum())
    assert (np.diff(energies) < 0.002 * energies[0]).all()


def repose(friction):
    """Angle in degrees of the flank of a column of grains that has collapsed."""
    rng, rows, z = np.random.default_rng(0), [], R
    steps = np.arange(-6, 7) * 2.25 * R
    while sum(map(len, rows)) < 1400:
        flat = np.stack(np.meshgrid(steps, steps), -1).reshape(-1, 2) + rng.uniform(-R, R, 2)
        flat = flat[np.hypot(*flat.T) < 0.1]
        flat = flat + rng.normal(0, 0.08 * R, flat.shape)
        rows.append(np.column_stack([flat, np.full(len(flat), z)]))
        z += 2.1 * R
    world = sand(np.concatenate(rows)[:1400], friction)
    for _ in range(25):
        world.wait()
    # In a cone the mean height is a quarter of its own, the mean distance half its radius.
    height, away = (world.grains[:, 2] - R).mean(), np.hypot(*world.grains[:, :2].T).mean()
    return np.degrees(np.arctan(2 * height / away))


def test_the_angle_of_repose_is_that_of_sand_and_grows_with_friction():
    slick, smooth, usual = (repose(friction) for friction in (0.05, 0.2, 0.55))
    assert 20 < usual < 40
    assert slick + 1 < smooth < usual - 3


@pytest.mark.parametrize("yaw", [0.0, 0.6])
def test_the_board_pushes_sand_ahead_and_nothing_passes_it(heap, yaw):
    world = sand(heap.grains.copy())
    middle, way = world.grains[:, :2].mean(0), np.array([np.cos(yaw), np.sin(yaw)])
    put(world, *(middle - 0.3 * way), yaw=yaw)
    before = world.grains.copy()
    action = np.array([*(0.025 * way), 0, 0, 0, 0, 0])
    was, through = in_board_frame(world), 0
    for _ in range(12):
        world.advance(action)
        assert in_board(world) < 0.1
        now = in_board_frame(world)
        # Grains may go over the top and round the ends, not through the face.
        face = (np.abs(was[:, 1:]) < HALF[1:] - R) & (np.abs(now[:, 1:]) < HALF[1:] - R)
        through += int((face.all(1) & (was[:, 0] * now[:, 0] < 0)).sum())
        was = now
    assert through == 0
    assert world.grains[:, 2].min() > 0.9 * R
    assert world.touches_board
    assert ((world.grains - before)[:, :2] @ way).mean() > 0.01


def in_board_frame(world):
    return (world.grains - world.board.position) @ world.board.rotation


@pytest.mark.parametrize("axis", range(3))
def test_a_change_of_the_quaternion_turns_the_board_about_that_axis(axis):
    world = sand([0, 0, R])
    put(world, 0.2, 0.1, 0.2)
    world.advance(np.concatenate([np.zeros(4), 0.1 * np.eye(3)[axis]]))
    angle = 2 * np.arctan(0.1)  # (1, 0.1) normalised
    expected = np.eye(3)
    a, b = (axis + 1) % 3, (axis + 2) % 3
    expected[[a, b], [a, b]] = np.cos(angle)
    expected[a, b], expected[b, a] = -np.sin(angle), np.sin(angle)
    np.testing.assert_allclose(world.board.rotation, expected, atol=1e-9)
    held = world.board.quaternion
    world.advance(np.array([0, 0, 0, *(0.1 * held)]))  # along itself: no turn at all
    np.testing.assert_allclose(world.board.quaternion, held, atol=1e-12)


def test_wild_actions_keep_the_board_over_the_table(heap):
    world, rng = sand(heap.grains.copy()), np.random.default_rng(3)
    put(world, -0.3, 0.0)
    for _ in range(25):
        world.advance(rng.uniform(-1, 1, 7) * [0.04, 0.04, 0.04, 0.15, 0.15, 0.15, 0.15])
        board = world.board
        lowest = board.position[2] - np.abs(board.rotation[2]) @ world.half
        assert lowest >= CLEARANCE - 1e-9
        assert (board.position[:2] >= LOW[:2]).all()
        assert (board.position[:2] <= HIGH[:2]).all()
        assert np.isfinite(world.grains).all()
        assert world.grains[:, 2].min() > 0.9 * R
        assert in_board(world) < 0.1
