"""Lines traced through pixels, against the arcs that were drawn."""

import numpy as np
import pytest

from acwm_estimators.curve import evenly, smoothed, trace

RADIUS, THICK = 30.0, 2.5


def drawn(middle, start, stop, shape=(100, 140)):
    """How likely each pixel shows an arc between two angles in rad, with soft edges."""
    y, x = np.mgrid[: shape[0], : shape[1]] + 0.5
    x, y = x - middle[0], y - middle[1]
    turn = (np.arctan2(y, x) - start) % (2 * np.pi)
    near = np.clip(THICK + 0.5 - np.abs(np.hypot(x, y) - RADIUS), 0, 1)
    return np.where(turn <= stop - start, near, 0.0)


def nothing(body):
    return np.zeros_like(body)


@pytest.mark.parametrize("middle", [(70, 50), (31, 33), (108, 69)])
@pytest.mark.parametrize(("start", "stop"), [(0.3, 2.8), (-2.0, 2.0), (3.0, 5.5)])
def test_the_line_is_the_middle_of_the_arc(middle, start, stop):
    body = drawn(middle, start, stop)
    line = trace(body, nothing(body))
    away = np.hypot(*(line - middle).T) - RADIUS
    assert np.abs(away[4:-4]).max() < 1
    assert np.abs(away).max() < THICK + 0.5  # an end is one of its corners
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    assert length == pytest.approx(RADIUS * (stop - start), rel=0.07)


def test_it_depends_on_the_arc_and_not_on_its_place_in_the_frame():
    small = drawn((35, 40), 0.5, 4.0, (80, 70))
    large = np.zeros((200, 190))
    large[90:170, 61:131] = small
    expected = trace(small, nothing(small)) + np.array([61, 90])
    np.testing.assert_allclose(trace(large, nothing(large)), expected, atol=1e-9)


def test_it_goes_on_behind_what_hides_the_body():
    body = drawn((70, 50), 0.5, 3.5)
    cover = np.zeros_like(body)
    cover[74:84, 66:74] = 1.0  # the lowest part of the arc
    line = trace(np.where(cover > 0, 0.0, body), cover)
    hidden = (line[:, 0] > 66) & (line[:, 0] < 74)
    assert hidden.any()
    assert np.abs(np.hypot(*(line[hidden] - [70, 50]).T) - RADIUS).max() < 3


def test_a_ring_a_dot_and_nothing_are_no_reading():
    ring = drawn((70, 50), -np.pi, np.pi)
    assert trace(ring, nothing(ring)) is None  # a way around half of it leaves the rest
    dot = np.zeros((50, 50))
    dot[20:22, 20:22] = 1
    assert trace(dot, nothing(dot)) is None
    assert trace(nothing(dot), nothing(dot)) is None
    assert trace(nothing(dot), dot) is None


def test_points_lie_at_equal_distances_between_the_ends():
    line = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 7.0]])
    np.testing.assert_allclose(evenly(line, 3), [[0, 0], [3, 2], [3, 7]])
    np.testing.assert_allclose(evenly(line, 3, end=1.0), [[1, 0], [3, 2], [3, 6]])


def test_smoothing_leaves_a_straight_line_and_both_ends():
    line = np.stack([np.arange(20.0), 2 * np.arange(20.0)], axis=1)
    np.testing.assert_allclose(smoothed(line, 1.5), line, atol=1e-9)
