"""Frames against geometry, and the caching against drawing everything anew."""

import numpy as np
import pytest

from acwm_sim.camera import Camera, Light
from acwm_sim.meshes import Mesh, box, capsule, plane
from acwm_sim.scene import Scene

ABOVE = Camera(eye=(0, 0, 2), up=(0, 1, 0), fov=40)
SUN = Light(direction=(1, 0, 1), softness=0.005)
RED, BLUE = (0.9, 0.2, 0.1), (0.1, 0.3, 0.9)


def turned(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def table(size=(120, 120), camera=ABOVE, light=SUN, **options):
    scene = Scene(camera, light, size, ((0, 0, 0), 1.0), **options)
    scene.add_mesh(plane(2.0), (0.9, 0.9, 0.9), static=True)
    return scene


def two_boxes(size=(120, 120)):
    scene = table(size)
    scene.add_mesh(box(0.1, 0.01), RED, instance=1)
    scene.add_mesh(box(0.08), BLUE, instance=2)
    return scene


PLACES = [
    (np.array([[x, 0.1, 0.1], [-0.3, y, 0.08]]), np.stack([turned(x), turned(y)]))
    for x, y in ((0.0, 0.2), (0.25, -0.2), (-0.1, 0.1))
]


def test_mask_is_what_was_drawn():
    scene = two_boxes()
    place = np.array([[0.2, 0.1, 0.1], [-0.3, -0.2, 0.08]])
    frame, mask = scene.render(place, np.stack([np.eye(3)] * 2))
    corners = np.array([[0.1, 0.0, 0.2], [0.3, 0.2, 0.2]])  # of the red box's upper face
    (x0, y1, _), (x1, y0, _) = ABOVE.project(corners, 120, 120)
    inside = mask[round(y0) + 1 : round(y1) - 1, round(x0) + 1 : round(x1) - 1]
    assert (inside == 1).all()
    assert set(np.unique(mask)) == {0, 1, 2}
    # Perspective shows the sides that face the middle, too, but nothing further out.
    assert not (mask[:, round(x1) + 1 :] == 1).any()
    red, blue = frame[mask == 1].mean(0), frame[mask == 2].mean(0)
    assert red[0] > 2 * red[2]
    assert blue[2] > 2 * blue[0]


def test_nearer_parts_hide_farther_ones_and_hidden_ones_are_gone():
    scene = two_boxes()
    place = np.array([[0.0, 0, 0.1], [0.0, 0, 0.5]])
    turns = np.stack([np.eye(3)] * 2)
    assert scene.render(place, turns)[1][60, 60] == 2
    scene.set_visible(1, False)
    mask = scene.render(place, turns)[1]
    assert mask[60, 60] == 1
    assert not (mask == 2).any()


@pytest.mark.parametrize(("direction", "side"), [((1, 0, 1), (-1, 0)), ((0, -1, 2), (0, 0.5))])
def test_a_shadow_falls_where_the_sun_says(direction, side):
    light = Light(direction=direction, softness=0.005)
    empty = table(light=light).render()[0].astype(float)
    scene = table(light=light)
    scene.set_spheres(scene.add_spheres(1, instance=1), [[0, 0, 0.4]], 0.08)
    frame, mask = scene.render(np.zeros((1, 3)), np.zeros((1, 3, 3)))
    change = (empty - frame).sum(2) * (mask == 0)
    dark = change > change.max() / 2
    rows, columns = np.nonzero(dark)
    # Along the light, the ball's middle falls on the table 0.4 m below it.
    x, y, _ = ABOVE.project(np.array([0.4 * side[0], 0.4 * side[1], 0]), 120, 120)
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx((x, y), abs=0.7)
    # The sun sees a disc; on the table it is stretched by 1 / cos of its angle to the vertical.
    focal = ABOVE.focal(120)
    cosine = direction[2] / np.linalg.norm(direction)
    assert dark.sum() == pytest.approx(np.pi * (0.08 * focal / 2) ** 2 / cosine, rel=0.1)


def test_occlusion_darkens_the_foot_of_a_box_only():
    scene = table(light=Light(direction=(0, 0, 1), softness=0.005), ao_radius=0.06)
    plain = scene.render()[0].astype(int)
    scene.add_mesh(box(0.1), instance=1)
    frame, mask = scene.render([[0, 0, 0.1]], [np.eye(3)])
    change = (plain - frame).sum(2)
    near, far = change[60, 70:72], change[60, 90:]
    assert mask[60, 68:71].tolist() == [1, 0, 0]
    assert near.min() > 7
    assert not far.any()


def test_a_frame_does_not_depend_on_the_frames_before():
    scene, again = two_boxes(), two_boxes()
    first = [scene.render(*place) for place in PLACES]
    for k in (2, 0, 1, 1):
        for one, other in zip(first[k], again.render(*PLACES[k]), strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("size", [(64, 64), (120, 88)])
def test_redrawing_only_what_moved_gives_the_same_bytes(size):
    place, turns = PLACES[1]
    frame, mask = two_boxes(size).render(place, turns)
    still = table(size)
    for k, (half, color) in enumerate((((0.1, 0.01), RED), ((0.08, 0.0), BLUE))):
        made = box(*half)
        moved = Mesh(
            (made.vertices @ turns[k].T + place[k]).astype(np.float32),
            (made.normals @ turns[k].T).astype(np.float32),
            made.triangles,
        )
        still.add_mesh(moved, color, instance=k + 1, static=True)
    frame_still, mask_still = still.render()
    # Poses are applied in double precision here and in single precision there.
    assert np.abs(frame.astype(int) - frame_still).max() <= 2
    assert (mask != mask_still).mean() < 1e-3


@pytest.mark.parametrize("height", [0.1, 0.15, 0.3, 0.8])
def test_what_hides_a_corner_changes_its_occlusion(height):
    """A box flies before a post whose foot darkens the floor, near it and far from it."""
    oblique = Camera(eye=(0.3, -1.6, 1.2), target=(0, 0, 0.1), fov=40)
    post = box((0.05, 0.05, 0.2)).moved((0, 0, 0.2))
    flying = box(0.1)
    toward = np.array([0.3, -1.6, 1.2]) * height
    moving, still = table(camera=oblique, ao_radius=0.06), table(camera=oblique, ao_radius=0.06)
    for scene in (moving, still):
        scene.add_mesh(post, BLUE, static=True, instance=2)
    moving.add_mesh(flying, RED, instance=1)
    still.add_mesh(flying.moved(toward), RED, static=True, instance=1)
    frame, mask = moving.render([toward], [np.eye(3)])
    frame_still, mask_still = still.render()
    assert (mask == 1).any()
    assert np.abs(frame.astype(int) - frame_still).max() <= 2
    assert (mask != mask_still).mean() < 1e-3


def test_a_small_frame_is_a_large_one_averaged():
    small = two_boxes((60, 60)).render(*PLACES[0])[0].astype(float) / 255
    large = two_boxes((240, 240)).render(*PLACES[0])[0].astype(float) / 255
    mean = (large**2.2).reshape(60, 4, 60, 4, 3).mean((1, 3)) ** (1 / 2.2)
    assert -10 * np.log10(((small - mean) ** 2).mean()) > 36
    assert np.abs(small - mean).mean() < 0.005


def test_colour_light_and_spheres_can_change():
    scene = two_boxes()
    frame, mask = scene.render(*PLACES[0])
    scene.set_color(0, (0.1, 0.8, 0.2))
    green = scene.render(*PLACES[0])[0][mask == 1].mean(0)
    assert green[1] > 2 * green[0]
    scene.set_light(Light(direction=(1, 0, 1), sun=(0.1, 0.1, 0.1)))
    assert scene.render(*PLACES[0])[0].mean() < 0.8 * frame.mean()
    scene.set_light(SUN)
    scene.set_color(0, RED)
    np.testing.assert_array_equal(scene.render(*PLACES[0])[0], frame)


def test_cameras_can_take_turns():
    cameras = [Camera(eye=(0.5 * k, -1.5, 1.2), fov=45) for k in range(6)]
    alone = []
    for camera in cameras:
        scene = two_boxes()
        scene.set_camera(camera)
        alone.append([scene.render(*place) for place in PLACES])
    scene = two_boxes()
    for k, place in enumerate(PLACES):
        for camera, frames in zip(cameras, alone, strict=True):
            scene.set_camera(camera)
            for one, other in zip(scene.render(*place), frames[k], strict=True):
                np.testing.assert_array_equal(one, other)


def test_a_sheet_can_be_deformed_and_shows_both_sides():
    scene = table()
    sheet = plane(0.2, 4)
    part = scene.add_mesh(sheet, BLUE, instance=1, solid=False)
    pose = ([[0, 0, 0.3]], [np.eye(3)])
    flat = (scene.render(*pose)[1] == 1).sum()
    folded = sheet.vertices.copy()
    folded[:, 0] = -np.abs(folded[:, 0])
    scene.set_vertices(part, folded, -sheet.normals)
    half = scene.render(*pose)[1] == 1
    assert half.sum() == pytest.approx(flat / 2, rel=0.05)
    assert not half[:, 61:].any()


def test_an_oblique_scene_with_particles_and_capsules():
    camera = Camera(eye=(1.2, -1.4, 1.0), target=(0, 0, 0.1), fov=45)
    scene = table((96, 160), camera=camera)
    rng = np.random.default_rng(0)
    grains = scene.add_spheres(400, (0.8, 0.7, 0.4), instance=1)
    scene.add_mesh(capsule(0.05, 0.2), RED, instance=2)
    scene.set_spheres(grains, rng.uniform((-0.3, -0.3, 0), (0.3, 0.3, 0.1), (400, 3)), 0.02)
    frame, mask = scene.render([[0, 0, 0], [-0.4, 0.4, 0.3]], np.stack([np.eye(3)] * 2))
    assert frame.shape == (96, 160, 3)
    assert (mask == 1).mean() > 0.02
    rows, columns = np.nonzero(mask == 2)
    x, y, _ = camera.project(np.array([-0.4, 0.4, 0.3]), 96, 160)
    assert (columns.mean() + 0.5, rows.mean() + 0.5) == pytest.approx((x, y), abs=0.7)


def test_instances_must_fit_in_a_byte():
    with pytest.raises(ValueError, match="instance id 256"):
        table().add_mesh(box(0.1), instance=256)
