"""Splatted nodes are seen where the renderer's camera sees them, and hide what is behind them."""

import numpy as np
import pytest
import torch

from acwm_core.env.camera import Camera
from acwm_scene.nodes import Form, NodeLayout, View, along_sides, facing
from acwm_scene.splatting import FINE, KNOWN, TEXTURE, Splatting

EYE = (0.0, -6.0, 9.0)
CAMERA = Camera(EYE, (0.0, 0.5, 0.0), fov=40.0)
SIZE = torch.Size((6, 8))
FAR = torch.full((1, 1, 1, 3), 1e3)  # an agent that nobody sees


def sheet(nodes, *, axes=3, light=None, frames=1):
    """What pixels show, `[T, height, width, …]`, where each node tells its place in the list."""
    layout = NodeLayout(1, axes, [3, 3] if len(nodes) == 9 else [len(nodes)], 1, 0.1)
    splatting = Splatting(layout, View(CAMERA, 0.1), light, frames=frames, values=1)
    places = torch.tensor(nodes, dtype=torch.float32)[None, None] / 0.1
    form = Form(FAR[..., :axes].expand(1, frames, -1, -1), places.expand(-1, frames, -1, -1))
    told = torch.arange(1.0, 1 + len(nodes))[None, :, None]
    with torch.no_grad():
        heard = splatting(form, told, torch.zeros(1, 1, 1), SIZE)
    assert heard.shape == (1, SIZE[0] * SIZE[1], splatting.channels)
    pictures, kinds = [], [1 + TEXTURE + KNOWN] + [KNOWN] * bool(light)
    for part in heard.split([frames * FINE**2 * each for each in kinds], 2):
        grid = part.view(*SIZE, frames, FINE, FINE, -1).permute(2, 0, 3, 1, 4, 5)
        pictures.append(grid.reshape(frames, SIZE[0] * FINE, SIZE[1] * FINE, -1).numpy())
    return pictures


def middle(cover):
    """The middle of what is covered: column and row, in pixels."""
    rows, columns = np.indices(cover.shape) + 0.5
    return np.array([(cover * columns).sum(), (cover * rows).sum()]) / cover.sum()


def seen_by_camera(points):
    return CAMERA.project(points, SIZE[0] * FINE, SIZE[1] * FINE)


def flat(side, height):
    x, y = np.meshgrid([-side, 0.0, side], [-side, 0.0, side])
    return np.stack([x.ravel(), y.ravel(), np.full(9, height)], -1)


def test_a_node_is_seen_where_the_camera_sees_it():
    for place in np.random.default_rng(0).uniform(-1, 1, (5, 3)):
        (picture,) = sheet(place[None])
        pixel = seen_by_camera(place[None])[0]
        np.testing.assert_allclose(middle(picture[0, ..., -1]), pixel[:2], atol=0.02)
        shown = picture[0, ..., -1] > 0
        expected = pixel[2] / 0.1 - np.linalg.norm(EYE) / 0.1  # farther than the origin, in units
        np.testing.assert_allclose(
            picture[0, shown, -2] / picture[0, shown, -1], expected, rtol=1e-3
        )


def test_a_sheet_covers_its_pixels_and_shows_what_its_nodes_tell():
    (picture,) = sheet(flat(0.8, 0))
    cover = picture[0, ..., -1]
    inside = np.round(seen_by_camera(flat(0.8, 0))[4, :2]).astype(int)
    assert cover.max() <= 1
    assert cover[inside[1], inside[0]] == 1
    assert picture[0, inside[1], inside[0], 0] == pytest.approx(5, abs=1)
    left, right = (seen_by_camera(flat(0.8, 0))[k, :2] for k in (3, 5))
    row = int(left[1])
    values = picture[0, row, int(left[0]) + 1 : int(right[0]), 0]
    assert (np.diff(values) > 0).all()


def test_what_is_in_front_hides_what_is_behind():
    """A rope of two halves, one under the other in the line of sight."""
    towards = np.array(EYE) / np.linalg.norm(EYE)
    near = np.linspace(-0.2, 0.2, 4)[:, None] * [1.0, 0, 0] + 0.8 * towards
    (picture,) = sheet(np.concatenate([near, near - 1.0 * towards]))
    pixel = seen_by_camera(near)[1, :2].astype(int)
    assert picture[0, pixel[1], pixel[0], 0] < 4.5


def test_shadows_lie_where_the_light_throws_them():
    """Under a light that leans by half, a node a metre up has its shadow half a metre beside it."""
    _, shadow = sheet([[0.0, 0.0, 1.0]], light=(0.5, 0.0, 1.0))
    pixel = seen_by_camera(np.array([[-0.5, 0.0, 0.0]]))[0, :2]
    np.testing.assert_allclose(middle(shadow[0, ..., -1]), pixel, atol=0.02)


def test_frames_stand_side_by_side_and_places_in_the_plane_lie_on_the_ground():
    (picture,) = sheet([[0.3, 0.2]], axes=2, frames=3)
    pixel = seen_by_camera(np.array([[0.3, 0.2, 0.0]]))[0, :2]
    for frame in picture:
        np.testing.assert_allclose(middle(frame[..., -1]), pixel, atol=0.02)


def test_what_is_outside_the_picture_covers_nothing():
    (picture,) = sheet(flat(0.1, 0) + np.array([50.0, 0, 0]))
    assert not picture[..., -1].any()


def test_a_cloth_faces_the_camera_with_one_of_its_sides():
    nodes = torch.tensor(flat(0.2, 0.0), dtype=torch.float32)[None]
    eye = torch.tensor([0.0, 0.0, 5.0])
    made = facing(nodes, along_sides(nodes, (3, 3)), eye)[0, 4]
    torch.testing.assert_close(made.abs(), torch.tensor([0.0, 0.0, 1.0, 1.0]), atol=1e-4, rtol=0)
    turned = nodes.flip(1)
    other = facing(turned, along_sides(turned, (3, 3)), eye)[0, 4]
    torch.testing.assert_close(other[3], made[3])  # turned by half, the same side is up
    mirrored = nodes.unflatten(1, (3, 3)).flip(1).flatten(1, 2)
    torch.testing.assert_close(facing(mirrored, along_sides(mirrored, (3, 3)), eye)[0, 4], -made)
