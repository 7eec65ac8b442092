"""Glass and fluid against the laws of light, and their caching against drawing everything anew."""

import numpy as np
import pytest

from acwm_sim.camera import Camera, Light
from acwm_sim.meshes import box, plane
from acwm_sim.scene import Scene

ABOVE = Camera(eye=(0, 0, 2), up=(0, 1, 0), fov=40)
SUN = Light(direction=(1, 0, 1), softness=0.005)
UPRIGHT = np.eye(3)[None]
SPACING = 0.02
HEAD_ON = {"glass": 0.04, "fluid": 0.02}  # reflectances at right angles: refractive index 1.5, 1.33


def table(size=(120, 120)):
    scene = Scene(ABOVE, SUN, size, ((0, 0, 0), 1.0))
    scene.add_mesh(plane(2.0), (0.9, 0.9, 0.9), static=True)
    return scene


def linear(frame):
    return (frame / 255.0) ** 2.2


def block(height, half=0.1, bottom=0.05):
    """Particles at rest that fill a block, in a cubic lattice."""
    across = np.arange(-half + SPACING / 2, half, SPACING)
    up = np.arange(bottom + SPACING / 2, bottom + height, SPACING)
    return np.stack(np.meshgrid(across, across, up), -1).reshape(-1, 3)


def pane(tint, z=0.4, half=0.06):
    scene = table()
    scene.add_glass(plane(half), (tint, tint, tint), instance=1)
    return scene.render([[0, 0, z]], UPRIGHT)


def test_a_pane_keeps_its_tint_of_the_light_behind_it():
    floor = linear(table().render()[0][60, 60])
    clear, grey, dark = (linear(pane(tint)[0][60, 60]) for tint in (1.0, 0.8, 0.5))
    # What it mirrors is the same for all three, so differences are transmitted light alone.
    kept = [t**2.2 for t in (1.0, 0.8, 0.5)]
    through = floor * (1 - HEAD_ON["glass"])
    np.testing.assert_allclose(clear - grey, through * (kept[0] - kept[1]), atol=0.01)
    np.testing.assert_allclose(clear - dark, through * (kept[0] - kept[2]), atol=0.01)
    np.testing.assert_allclose(dark, through * kept[2], atol=0.15)  # and mirrors only a little


def test_a_pane_casts_a_shadow_of_its_tint():
    bare = table().render()[0]
    # The sun stands at 45°, so the shadow of a pane 0.4 m up falls 0.4 m beside it.
    x, y, _ = ABOVE.project(np.array([-0.4, 0, 0]), 120, 120)
    darker = [linear(bare[int(y), int(x)]) - linear(pane(t)[0][int(y), int(x)]) for t in (0.9, 0.5)]
    assert (darker[0] > 0.01).all()
    assert (darker[1] > 2 * darker[0]).all()
    # Even black glass takes no more than the sun's share of the light.
    shadow = table()
    shadow.add_mesh(plane(0.06), static=False, instance=1, solid=False)
    opaque = linear(shadow.render([[0, 0, 0.4]], UPRIGHT)[0][int(y), int(x)])
    assert (linear(pane(0.01)[0][int(y), int(x)]) >= opaque - 0.01).all()


def test_glass_owns_only_what_is_nobody_elses():
    scene = table()
    scene.add_glass(plane(0.2), instance=1)
    scene.add_mesh(box(0.05), instance=2)
    scene.add_mesh(box(0.03), instance=3)
    mask = scene.render([[0, 0, 0.5], [0, 0, 0.05], [0.12, 0, 0.7]], np.tile(UPRIGHT, (3, 1, 1)))[1]
    assert mask[60, 60] == 2  # seen through the glass
    x, y, _ = ABOVE.project(np.array([0.12, 0, 0.73]), 120, 120)
    assert mask[int(y), int(x)] == 3  # before it
    x, y, _ = ABOVE.project(np.array([-0.12, 0.1, 0.5]), 120, 120)
    assert mask[int(y), int(x)] == 1
    assert mask[2, 2] == 0
    side = 0.4 * ABOVE.focal(120) / 1.5
    boxes = (mask == 2).sum() + (mask == 3).sum()
    assert (mask == 1).sum() + boxes == pytest.approx(side**2, rel=0.03)


@pytest.mark.parametrize("height", [0.1, 0.2])
def test_a_fluid_absorbs_as_its_depth_says(height):
    """Beer and Lambert: half the red is left after each 0.1 m."""
    half = 0.5 ** (1 / 2.2)  # as a display colour
    seen = []
    for color in ((1.0, 1.0, 1.0), (half, 1.0, 1.0)):
        scene = table()
        water = scene.add_fluid(color, instance=1, depth=0.1, haze=0.0)
        scene.set_fluid(water, block(height, bottom=0.4), SPACING / 2)
        seen.append(linear(scene.render(np.zeros((1, 3)), UPRIGHT)[0])[55:65, 55:65].mean((0, 1)))
    floor = linear(table().render()[0][60, 60])[0]
    taken = seen[0][0] - seen[1][0]
    # The fluid's own shadow falls beside it, so the floor behind it is lit.
    lit = floor * (1 - HEAD_ON["fluid"])
    assert taken == pytest.approx(lit * (1 - 0.5 ** (height / 0.1)), rel=0.08)
    assert abs(seen[0][1] - seen[1][1]) < 0.01


def test_a_fluid_has_its_own_mask_and_hides_behind_what_is_opaque():
    scene = table()
    water = scene.add_fluid(instance=1)
    scene.add_mesh(box(0.05), instance=2)
    scene.set_fluid(water, block(0.1), SPACING / 2)
    poses = [[0, 0, 0], [0, 0, 0.5]]
    mask = scene.render(poses, np.tile(UPRIGHT, (2, 1, 1)))[1]
    assert mask[60, 60] == 2
    side = 0.2 * ABOVE.focal(120) / 1.85
    covered = (mask == 2).sum()
    assert (mask == 1).sum() + covered == pytest.approx(side**2, rel=0.12)
    scene.set_visible(water, False)
    assert not (scene.render(poses, np.tile(UPRIGHT, (2, 1, 1)))[1] == 1).any()


def everything(size):
    scene = table(size)
    scene.add_glass(plane(0.3).moved((0.2, 0.2, 0.3)), static=True, instance=4)
    scene.add_fluid(instance=1)
    scene.add_glass(plane(0.1), (0.8, 0.9, 0.9), instance=2)
    scene.add_mesh(box(0.05), (0.9, 0.2, 0.1), instance=3)
    return scene


def shown(scene, k):
    rng = np.random.default_rng(k)
    scene.set_fluid(0, block(0.06) + rng.uniform(-0.3, 0.3, 3) * (1, 1, 0), SPACING / 2)
    places = rng.uniform((-0.5, -0.5, 0.1), (0.5, 0.5, 0.6), (3, 3))
    return scene.render(places, np.tile(UPRIGHT, (3, 1, 1)))


@pytest.mark.parametrize(
    "size", [pytest.param((64, 64), marks=pytest.mark.slow), (120, 88), (130, 130)]
)
def test_a_frame_does_not_depend_on_the_frames_before(size):
    used = everything(size)
    for k in (0, 1, 2, 1, 0):
        for one, other in zip(shown(used, k), shown(everything(size), k), strict=True):
            np.testing.assert_array_equal(one, other)


def test_a_single_drop_is_as_large_as_it_is():
    scene = table()
    water = scene.add_fluid(instance=1)
    scene.set_fluid(water, [[0.1, 0.2, 0.5]], 0.05)
    mask = scene.render(np.zeros((1, 3)), UPRIGHT)[1]
    rows, columns = np.nonzero(mask == 1)
    x, y, _ = ABOVE.project(np.array([0.1, 0.2, 0.5]), 120, 120)
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx((x, y), abs=0.7)
    # Drawn 1.5 times as large as half the spacing, so that gaps close.
    area = np.pi * (1.5 * 0.05 * ABOVE.focal(120) / 1.5) ** 2
    assert (mask == 1).sum() == pytest.approx(area, rel=0.15)


def test_misuse_is_told():
    scene = table()
    part = scene.add_mesh(box(0.1))
    with pytest.raises(ValueError, match="is not a fluid"):
        scene.set_fluid(part, block(0.1), 0.01)
    scene.add_fluid()
    with pytest.raises(ValueError, match="one fluid"):
        scene.add_fluid()
