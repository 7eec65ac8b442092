"""Cameras, orientations and codes against what the environments themselves say."""

import numpy as np
import pytest

from acwm_core.env.rotations import (
    angle_code,
    angle_of_code,
    rotation_code,
    rotation_of_code,
)
from acwm_estimators.curve import same_end_first
from acwm_estimators.turns import upright
from acwm_sim.camera import Camera
from acwm_sim.geometry import outer_radius


def rotations(rng, count):
    values = rng.standard_normal((count, 4))
    return values / np.linalg.norm(values, axis=-1, keepdims=True)


def angle_between(a, b):
    return 2 * np.arccos(np.clip(np.abs((a * b).sum(-1)), 0, 1))


def test_frame_coordinates_are_where_the_renderer_draws():
    camera = Camera((1.10, -0.75, 0.85), (0.42, 0.0, 0.175), fov=34)
    points = np.random.default_rng(0).uniform(-0.3, 0.3, (50, 3))
    theirs, ours = camera.project(points, 240, 400), camera.to_frame(points)
    np.testing.assert_allclose(ours[:, :2] * 240 + [200, 120], theirs[:, :2], atol=1e-3)
    np.testing.assert_allclose(ours[:, 2], theirs[:, 2], atol=1e-5)


def test_a_point_is_found_again_by_its_depth_or_by_its_plane():
    camera = Camera((1.0, -2.0, 1.5), (0.1, 0.0, 0.2), fov=40)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    seen = camera.to_frame(points)
    np.testing.assert_allclose(camera.from_frame(seen), points, atol=1e-9)
    for point, place in zip(points, seen, strict=True):
        np.testing.assert_allclose(camera.on_plane(place[:2], point[2]), point, atol=1e-9)


@pytest.mark.parametrize("fold", [1, 2, 4])
def test_angles_come_back_up_to_the_turns_that_change_nothing(fold):
    angles = np.linspace(-np.pi, np.pi, 41)
    found = angle_of_code(3.0 * angle_code(angles, fold), fold)
    off = (found - angles) * fold / (2 * np.pi)
    np.testing.assert_allclose(off, np.round(off), atol=1e-9)


def test_boxes_come_back_as_one_of_the_rotations_that_look_alike():
    rng = np.random.default_rng(2)
    true = rotations(rng, 30)
    found = rotation_of_code(rotation_code(true, "box"), "box")
    w, x, y, z = np.moveaxis(found, -1, 0)
    alike = [(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)]
    nearest = np.min([angle_between(np.stack(each, -1), true) for each in alike], axis=0)
    assert nearest.max() < 1e-5
    turned = np.stack([-true[:, 3], true[:, 2], -true[:, 1], true[:, 0]], -1)  # half around z
    np.testing.assert_allclose(rotation_code(turned, "box"), rotation_code(true, "box"), atol=1e-12)


def test_upright_quaternions_turn_around_z():
    np.testing.assert_allclose(upright(np.array([np.pi / 2])), [[0.5**0.5, 0, 0, 0.5**0.5]])


@pytest.mark.parametrize("size", [64, 240])
def test_the_radius_of_a_ball_is_that_of_what_is_seen_of_it(size):
    """A disc of 0.15 frame heights, bare, half covered, drawn larger, all covered."""
    rows, columns = np.mgrid[:size, : 2 * size] + 0.5
    x, y = (columns - size) / size - 0.1, (rows - size / 2) / size + 0.05
    masks = np.zeros((4, size, 2 * size), np.uint8)
    for frame, radius in enumerate((0.15, 0.15, 0.195, 0.15)):
        masks[frame][np.hypot(x, y) < radius] = 1
    masks[1][x > 0] = 2
    masks[3][np.hypot(x, y) < 0.3] = 2
    seen = outer_radius(masks, 1, np.array([0.1, -0.05]))
    assert seen[:3] == pytest.approx([0.15, 0.15, 0.195], abs=0.5 / size)
    assert np.isnan(seen[3])


def test_curves_keep_their_first_end_from_frame_to_frame():
    line = np.stack([np.linspace(0, 1, 9), np.zeros(9)], axis=-1)
    drifting = line + np.array([0.0, 0.01]) * np.arange(6)[:, None, None]
    flipped = drifting.copy()
    flipped[[1, 2, 4]] = drifting[[1, 2, 4], ::-1]
    np.testing.assert_array_equal(same_end_first(flipped), drifting)
