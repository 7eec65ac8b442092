"""Distances of every world's tasks against numbers found another way, and solutions."""

import numpy as np
import pytest

from acwm_core.evaluation.clips import as_clip
from acwm_core.evaluation.score import estimator_for
from tests.extras import needs
from tests.tasks.playing import begin, like, make, seen, solve

pytestmark = needs("mujoco", "pybullet", "taichi")

FAST = ("push_cube.place", "push_cube.place_and_turn", "reacher.reach", "robot_arm.reach")
SLOW = (
    "stack_cube.stack",
    "push_rope.shape",
    "cloth_move.edge",
    "push_sand.gather",
    "pour_water.fill",
)
EVERY = [*FAST, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)]


@pytest.fixture(scope="module", params=EVERY)
def world(request):
    """A task's name, and the environment with it."""
    env = make(*request.param.split("."))
    yield request.param, env
    env.close()


def test_the_solution_succeeds_and_comes_nearer(world):
    infos = solve(world[1])
    assert infos[-1]["success"]
    assert not infos[-1]["failed"]
    assert infos[0]["distance"] > 2 * infos[-1]["distance"]
    assert not infos[0]["success"]


def test_another_episode_has_another_goal(world):
    """That the same one has the same goal, and starts as without it, is what its checks try."""
    _, env = world
    begin(env)
    goal = env.goal
    begin(env, 1)
    assert not np.array_equal(env.goal.frame, goal.frame)


TOLD = {
    "push_sand.gather": 0.12,
    "robot_arm.reach": 0.12,
    "cloth_move.edge": 0.1,
}
"""How far the distance of what is read from a frame may be off; 0.05 for others."""


def test_an_estimator_reads_what_the_distance_needs(world):
    name, env = world
    frame, info = begin(env)
    video = as_clip(np.stack([frame, env.goal.frame]))
    read = estimator_for(env.environment.card).estimate(video)
    told = env.task.distance(read, env.goal)
    assert env.task.success(read, env.goal).shape == (2,)
    known = np.isfinite(told)  # the start may hide a hand
    assert known[1]
    distances = np.array([info["distance"], 0.0])
    np.testing.assert_allclose(told[known], distances[known], atol=TOLD.get(name, 0.05))


def test_cubes_are_placed_by_their_middles_whatever_is_unseen():
    env = make("push_cube", "place")
    for index in range(9):
        begin(env, index)
        there = env.goal.state["cube_present"] > 0
        if there.sum() == 2:
            break
    moved = np.repeat(env.goal.state["cube_position"][None], 3, 0)
    first, second = np.flatnonzero(there)
    moved[0, first, :2] += [0.03, 0.04]
    moved[0, second, 0] += 0.01
    moved[1, first, 0] += 0.016
    moved[2, second] = np.nan
    found = like(env.goal, 3, cube_position=moved)
    np.testing.assert_allclose(env.task.distance(found, env.goal), [0.03, 0.008, np.nan], atol=1e-6)
    # Less than the tolerance on average is no success: one cube is 1.6 cm off.
    assert not env.task.success(found, env.goal).any()


def corners(position, yaw):
    """Of a cube's top, from its centre and heading: [4, 2]."""
    half = position[2] * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    c, s = np.cos(yaw), np.sin(yaw)
    return position[:2] + half @ np.array([[c, s], [-s, c]])


def test_turned_cubes_are_off_by_their_corners_and_quarter_turns_do_not_count():
    env = make("push_cube", "place_and_turn")
    begin(env)
    goal = env.goal
    yaws = goal.state["cube_yaw"] + np.array([[0.2], [np.pi / 2]])
    there = np.flatnonzero(goal.state["cube_present"])
    moved = np.repeat(goal.state["cube_position"][None], 2, 0)
    moved[0, :, 0] += 0.01
    rms = [
        np.sqrt(
            (
                (
                    corners(moved[0, k], yaws[0, k])
                    - corners(goal.state["cube_position"][k], goal.state["cube_yaw"][k])
                )
                ** 2
            )
            .sum(1)
            .mean()
        )
        for k in there
    ]
    found = env.task.distance(like(goal, 2, cube_yaw=yaws, cube_position=moved), goal)
    np.testing.assert_allclose(found, [np.mean(rms), 0], atol=1e-6)


def test_the_tip_is_where_forward_kinematics_say():
    env = make("reacher", "reach")
    begin(env)
    state, goal = env.goal.state, env.goal
    shoulder, elbow = state["joint_angle"]
    tip = 0.5 * np.array([np.cos(shoulder), np.sin(shoulder)])
    tip += 0.4 * np.array([np.cos(shoulder + elbow), np.sin(shoulder + elbow)])
    np.testing.assert_allclose(tip, state["goal_position"], atol=1e-5)
    far = seen(fingertip_position=np.array([tip + np.array([0.3, 0.4]), [np.nan, 0.0]]))
    np.testing.assert_allclose(env.task.distance(far, goal), [0.5, np.nan], atol=1e-5)
    assert env.task.success(far, goal).tolist() == [False, False]


def test_an_arm_inside_of_a_post_has_failed():
    env = make("robot_arm", "reach")
    begin(env)
    goal = env.goal
    hands = np.linalg.norm(goal.state["goal_position"] - goal.state["hand_position"], axis=1)
    assert hands.min() < 1e-3
    post = goal.state["obstacle_position"][0]
    links = np.repeat(goal.state["link_position"][None], 2, 0)
    links[1, 4:] = post
    found = like(goal, 2, link_position=links)
    assert env.task.failed(found, goal).tolist() == [False, True]
    assert env.task.success(found, goal).tolist() == [True, False]
    names = env.environment.card.instances
    assert {pair[1] for pair in env.task.avoid} == {n for n in names if n.startswith("obstacle")}
    env.close()


def test_red_counts_from_green_and_only_once_the_hand_is_gone():
    env = make("stack_cube", "stack")
    begin(env)
    goal = env.goal
    cubes = np.repeat(goal.state["cube_position"][None], 3, 0)
    cubes[1] += [0.1, -0.2, 0.0]  # both: still stacked
    cubes[2, 0] += [0.03, 0.0, 0.04]
    hands = np.repeat(goal.state["hand_position"][None], 3, 0)
    hands[1] = cubes[1, 0]
    found = like(goal, 3, cube_position=cubes, hand_position=hands)
    np.testing.assert_allclose(env.task.distance(found, goal), [0, 0, 0.05], atol=1e-6)
    assert env.task.success(found, goal).tolist() == [True, False, False]
    edge = goal.state["cube_position"][0, 2] - goal.state["cube_position"][1, 2]
    assert edge == pytest.approx(2 * goal.state["cube_position"][1, 2], abs=1e-5)
    env.close()


def test_a_rope_has_no_first_end():
    env = make("push_rope", "shape")
    begin(env)
    rope = env.goal.state["rope_position"]
    found = like(env.goal, 2, rope_position=np.stack([rope[::-1], rope + np.array([0.03, 0.04])]))
    near = env.task.distance(found, env.goal)
    np.testing.assert_allclose(near, [0, 0.05], atol=1e-6)


def test_sand_counts_by_its_volume_inside_of_the_region():
    from acwm_core.env.task import Goal
    from acwm_particle.sand_task import GATHER

    heights = np.zeros((3, 24, 40))
    heights[:, 10:14, 20:24] = 0.05  # 4 x 4 cells of 4 cm beside the middle
    heights[1:, 0:4, 0:4] = 0.05  # as much in a corner
    heights[2, 0:4, 0:4] = 0.03  # half as much above the 1 cm that lone grains reach
    region = np.array([0.08, 0.0, 0.25])
    goal = Goal({"sand_height": heights[0], "region": region}, *[np.zeros((8, 8), np.uint8)] * 2)
    board = np.tile([0.0, 0.0, 0.3], (3, 1))
    found = seen(sand_height=heights, board_position=board)
    np.testing.assert_allclose(GATHER.distance(found, goal), [0, 1 / 2, 1 / 3], atol=1e-6)
    assert GATHER.success(found, goal).tolist() == [True, False, False]
    assert not GATHER.success(seen(sand_height=heights, board_position=0 * board), goal).any()


def test_water_counts_once_it_has_come_down_and_spilling_is_for_good():
    from acwm_core.env.task import Goal
    from acwm_particle.water_task import FILL

    goal = Goal({"water_share": np.array([0.5, 0.5, 0.0])}, *[np.zeros((8, 8), np.uint8)] * 2)
    shares = [
        [0.4, 0.5, 0.0],
        [0.5, 0.48, 0.015],
        [0.5, 0.47, 0.0],
        [0.47, 0.5, 0.03],
        [0.5, 0.5, 0.0],
    ]
    found = seen(water_share=np.array(shares))
    np.testing.assert_allclose(FILL.distance(found, goal), [0, 0.04, 0.06, 0, 0], atol=1e-9)
    assert FILL.failed(found, goal).tolist() == [False, False, False, True, False]
    assert FILL.success(found, goal).tolist() == [False, True, False, False, False]
