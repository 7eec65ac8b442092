"""robot_arm's planner: paths that touch nothing, motions within their limits."""

import numpy as np
import pytest

from acwm_kinematics.arm_layout import (
    APART,
    CENTRAL,
    EXPANDED,
    GOALS,
    HOME,
    OFFSETS,
    Workspace,
    draw_layout,
)
from acwm_kinematics.arm_planner import MARGIN, Clearance, plan
from acwm_kinematics.arm_simulation import Post
from acwm_kinematics.arm_timing import MAX_ACCELERATION, MAX_SPEED, rounded, timed
from acwm_sim.panda import LOWER, UPPER

BOX = Workspace("central").box
LEFT, RIGHT = HOME + np.eye(7)[0] * 0.55, HOME - np.eye(7)[0] * 0.6
WALL = Post((0.58, 0.0), 0.04, 0.42, round=True)  # where the hand would pass between these two


@pytest.fixture(scope="module")
def blocked():
    return Clearance((WALL,))


@pytest.fixture(scope="module")
def exact():
    return Clearance((WALL,), margin=0.0)


@pytest.fixture(scope="module")
def paths(blocked):
    """Paths around the post, for ten seeds."""
    found = [plan(blocked, LEFT, RIGHT, BOX, np.random.default_rng(k)) for k in range(10)]
    return [path for path in found if path is not None]


def test_clearance_sees_table_posts_and_the_arm_itself(exact):
    assert exact.is_free(HOME + np.eye(7)[0] * 0.5)
    assert not exact.is_free(HOME)  # the hand in the post
    assert not exact.is_free(HOME + np.array([0.5, 0.8, 0, 0, 0, 0, 0]))  # in the table
    folded = np.array([0.5, -1.6, 0, -3.05, 0, 0.0, 0.8])
    assert not exact.is_free(folded)  # the hand in the arm


def test_margins_are_kept(blocked, exact):
    """The angle at which the arm gets too near comes before the one at which it touches."""
    angles = np.arange(0.6, 0.0, -0.005)
    first = [
        next(a for a in angles if not world.is_free(HOME + np.eye(7)[0] * a))
        for world in (blocked, exact)
    ]
    reach = 0.6  # metres of the hand from the first joint's axis
    assert (first[0] - first[1]) * reach == pytest.approx(MARGIN, abs=0.01)


def test_the_straight_line_is_taken_where_it_is_free():
    empty = Clearance(())
    path = plan(empty, LEFT, RIGHT, BOX, np.random.default_rng(0))
    np.testing.assert_array_equal(path, [LEFT, RIGHT])
    empty.close()


def test_it_finds_short_ways_around_a_post(blocked, exact, paths):
    assert not blocked.is_edge_free(LEFT, RIGHT)
    assert len(paths) == 10
    lengths = []
    for path in paths:
        np.testing.assert_array_equal(path[[0, -1]], [LEFT, RIGHT])
        assert ((path >= BOX[0] - 1e-9) & (path <= BOX[1] + 1e-9)).all()
        assert exact.is_path_free(path, resolution=0.005)
        assert exact.is_path_free(rounded(blocked, path), resolution=0.005)
        lengths.append(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    straight = np.linalg.norm(RIGHT - LEFT)
    assert straight < np.median(lengths) < 2.5 * straight


def test_it_gives_up_after_a_fixed_effort(blocked):
    assert plan(blocked, LEFT, HOME, BOX, np.random.default_rng(0)) is None  # a goal in the post
    narrow = (np.minimum(LEFT, RIGHT) - 1e-3, np.maximum(LEFT, RIGHT) + 1e-3)  # no way around
    before = blocked.checked
    assert plan(blocked, LEFT, RIGHT, narrow, np.random.default_rng(0)) is None
    assert blocked.checked - before < 2200


def test_motions_keep_their_limits_and_end_at_rest(blocked, paths):
    for path in paths:
        frame = 0.002
        motion = np.vstack([path[0], timed(rounded(blocked, path), frame)])
        np.testing.assert_array_equal(motion[-1], path[-1])
        speed = np.diff(motion, axis=0) / frame
        assert np.abs(speed).max() < 1.02 * MAX_SPEED
        assert np.abs(speed).max() > 0.6 * MAX_SPEED  # and it does not dawdle
        assert np.abs(speed[[0, -1]]).max() < 0.15
        smooth = np.stack([np.convolve(v, np.ones(25) / 25, "valid") for v in speed.T], axis=1)
        assert np.abs(np.diff(smooth, axis=0) / frame).max() < MAX_ACCELERATION


@pytest.mark.parametrize("haste", [1.0, 0.5])
def test_a_straight_motion_takes_the_time_of_a_trapezoid_of_speed(haste):
    motion = timed(np.array([LEFT, RIGHT]), 0.1, haste)
    speed, acceleration = haste * MAX_SPEED, haste * MAX_ACCELERATION / 2
    ideal = np.abs(RIGHT - LEFT).max() / speed + speed / acceleration
    assert 0 <= len(motion) * 0.1 - ideal < 0.1  # up to a whole number of frames
    assert np.abs(np.diff(np.vstack([LEFT, motion]), axis=0)).max() < 0.1 * speed + 1e-9


def test_a_motion_to_where_the_arm_is_takes_a_frame():
    """As in episode 405 of train with seed 0, in which a pose is drawn twice in a row."""
    assert timed(np.array([LEFT, LEFT]), 0.1).tolist() == [LEFT.tolist()]


@pytest.mark.parametrize("name", ["central", "expanded"])
def test_layouts_leave_everything_free_and_apart(name):
    low, high = OFFSETS["central"]
    for seed in range(6):
        layout = draw_layout(Workspace(name), 3, 0.26, np.random.default_rng(seed))
        exact = Clearance(layout.posts, margin=0.0)
        assert len(layout.posts) == 3
        assert layout.goals.shape == (GOALS, 3)
        gaps = np.linalg.norm(layout.goals[:, None] - layout.goals[None], axis=2)
        assert gaps[np.triu_indices(GOALS, 1)].min() > APART
        for joints, goal in zip(layout.poses, layout.goals, strict=True):
            assert exact.is_free(joints)
            np.testing.assert_allclose(exact.panda.hand_pose[0], goal, atol=1e-9)
            assert ((joints >= LOWER) & (joints <= UPPER)).all()
            offset, inside = joints - HOME, ((goal >= CENTRAL[0]) & (goal <= CENTRAL[1])).all()
            usual = ((offset >= low) & (offset <= high)).all()
            assert (inside and usual) == (name == "central")
            assert inside == usual
            assert ((goal >= EXPANDED[0]) & (goal <= EXPANDED[1])).all()
        start = layout.start - HOME
        assert exact.is_free(layout.start)
        assert ((start >= low) & (start <= high)).all()
        exact.close()
        layout.clearance.close()
