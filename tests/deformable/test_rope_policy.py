"""What the policy of push_rope relies on: ways around the rope, and pushes that start beside it."""

import numpy as np
import pytest

from acwm_deformable.physics import POLE_RADIUS
from acwm_deformable.rope import NODES, POLE_ROOM, Cord
from acwm_deformable.rope_curves import lay_rope
from acwm_deformable.rope_paths import ClearanceGrid
from acwm_deformable.rope_policy import Pusher

REACH = 0.13


def across(half=0.6):
    """A straight rope along x."""
    return np.column_stack([np.linspace(-half, half, NODES), np.zeros(NODES)])


def walked(start, corners, step=0.01):
    """Points along a way."""
    points = [start]
    for corner in corners:
        count = max(2, int(np.linalg.norm(corner - points[-1]) / step))
        points += list(np.linspace(points[-1], corner, count)[1:])
    return np.array(points)


def test_a_free_way_is_straight():
    start, goal = np.array([-0.5, 0.5]), np.array([0.7, 0.8])
    chart = ClearanceGrid(across(), start, REACH)
    assert len(chart.way(goal)) == 1
    straight = np.linalg.norm(goal - start)
    assert straight - 0.1 < chart.cost(goal) < 1.15 * straight


def test_the_way_leads_around_the_end_of_the_rope():
    start, goal = np.array([0.2, -0.4]), np.array([0.3, 0.4])
    chart = ClearanceGrid(across(), start, REACH)
    way = chart.way(goal)
    line = walked(start, way)
    np.testing.assert_allclose(way[-1], goal)
    gaps = np.linalg.norm(line[:, None] - across(), axis=-1).min(1)
    assert gaps.min() > REACH - 0.01
    assert line[:, 0].max() > 0.6  # around the nearer end
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    assert length == pytest.approx(chart.cost(goal), rel=0.15)


def test_places_out_of_reach_cost_infinitely_much():
    wall = across(POLE_ROOM[0] + 0.1)
    chart = ClearanceGrid(wall, np.array([0.0, -0.5]), REACH)
    assert chart.cost(np.array([0.0, 0.5])) == np.inf  # behind a rope from edge to edge
    assert chart.cost(np.array([0.0, 0.05])) == np.inf  # in the rope
    assert chart.cost(np.array([2.0, 0.0])) == np.inf  # off the table
    assert chart.cost(np.array([0.5, -0.5])) < 0.6


def test_a_pole_that_touches_the_rope_can_leave_it():
    start = np.array([0.0, -0.105])
    chart = ClearanceGrid(across(), start, REACH)
    assert chart.cost(np.array([0.0, -0.6])) < 0.7


def test_random_ways_never_touch_the_rope():
    rng = np.random.default_rng(0)
    found = 0
    for _ in range(12):
        nodes = lay_rope(Cord(2.4), rng).nodes
        start, goal = rng.uniform(-0.9, 0.9, (2, 2))
        if min(np.linalg.norm(nodes - place, axis=1).min() for place in (start, goal)) < REACH:
            continue
        chart = ClearanceGrid(nodes, start, REACH)
        if np.isfinite(chart.cost(goal)):
            found += 1
            line = walked(start, chart.way(goal))
            gaps = np.linalg.norm(line[:, None] - nodes, axis=-1).min(1)
            assert gaps.min() > POLE_RADIUS + 0.035
    assert found > 4


def test_pushes_start_beside_the_rope_and_cross_it():
    rng = np.random.default_rng(1)
    rope = lay_rope(Cord(2.4), rng)
    rope.pole[:] = (0.9, 0.9)
    policy = Pusher(rope, 0.06, rng)
    for _ in range(20):
        plan = policy._plan()
        assert plan is not None
        start = plan.way[-1]
        ahead = np.array([np.cos(plan.heading), np.sin(plan.heading)])
        gap = np.linalg.norm(rope.nodes - start, axis=1).min()
        assert POLE_RADIUS + 0.035 < gap < 0.15
        beam = start + np.linspace(0, 0.2, 41)[:, None] * ahead
        assert np.linalg.norm(beam[:, None] - rope.nodes, axis=-1).min() < 0.05
