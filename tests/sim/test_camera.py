"""Where things land in the frame, against projective geometry."""

import numpy as np
import pytest

from acwm_sim.camera import Camera, Light
from acwm_sim.scene import Scene

NEVER = (0.0, 0.0, -50.0)


def sphere_mask(center, radius, size=(200, 200), camera=None):
    camera = camera or Camera(eye=(0, 0, 2), up=(0, 1, 0), fov=50)
    scene = Scene(camera, Light(), size, ((0, 0, 0), 1.0))
    scene.set_spheres(scene.add_spheres(1, instance=3), [center], radius)
    return scene.render(np.zeros((1, 3)), np.zeros((1, 3, 3)))[1] == 3


def test_projection_from_above():
    camera = Camera(eye=(0, 0, 2), up=(0, 1, 0), fov=90)
    pixels = camera.project(np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0.5, 0.5, 1]]), 100, 160)
    expected = [[80, 50, 2], [130, 50, 2], [80, 0, 2], [105, 25, 1]]
    np.testing.assert_allclose(pixels, expected, atol=1e-4)


def test_oblique_projection_puts_the_target_in_the_middle():
    camera = Camera(eye=(1.0, -2.0, 1.5), target=(0.2, 0.1, 0.3), fov=40)
    x, y, depth = camera.project(np.array([0.2, 0.1, 0.3]), 90, 120)
    distance = np.linalg.norm([0.8, -2.1, 1.2])
    np.testing.assert_allclose([x, y, depth], [60, 45, distance], rtol=1e-4)
    assert camera.project(np.array([0.2, 0.1, 0.5]), 90, 120)[1] < 45  # up is up


@pytest.mark.parametrize(
    ("center", "radius"), [((0, 0, 0), 0.3), ((0.5, 0.3, 0.4), 0.2), ((-0.6, 0.5, 0), 0.25)]
)
def test_sphere_silhouette_has_the_analytic_area_and_place(center, radius):
    mask = sphere_mask(center, radius)
    # A sphere at (x, y, z) in camera coordinates projects to an ellipse of known area.
    focal = 100 / np.tan(np.radians(25))
    x, y, z = center[0], center[1], 2 - center[2]
    rest = z * z - radius**2
    area = np.pi * (focal * radius) ** 2 / rest * np.sqrt((x * x + y * y + rest) / rest)
    assert mask.sum() == pytest.approx(area, rel=0.01)
    rows, columns = np.nonzero(mask)
    stretch = z / rest * focal  # centre of that ellipse
    middle = (columns.mean() + 0.5, rows.mean() + 0.5)
    assert middle == pytest.approx((100 + stretch * x, 100 - stretch * y), abs=0.3)


def test_framing_does_not_depend_on_the_size():
    shares = [sphere_mask((0.2, 0.1, 0), 0.4, (n, n)).mean() for n in (64, 120, 240)]
    assert shares == pytest.approx([shares[-1]] * 3, rel=0.02)


def test_wide_frames_see_more_to_the_sides():
    wide = sphere_mask((0.2, 0.1, 0), 0.4, (64, 112))
    square = sphere_mask((0.2, 0.1, 0), 0.4, (64, 64))
    np.testing.assert_array_equal(wide[:, 24:88], square)
