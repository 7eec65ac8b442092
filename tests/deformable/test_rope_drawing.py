"""What push_rope looks like: the rope's surface, its stripes, and the mask."""

import numpy as np
import pytest

from acwm_core.env.episode import EpisodeSpec
from acwm_deformable.push_rope import PushRope
from acwm_deformable.rope import Cord
from acwm_deformable.rope_curves import lay_rope
from acwm_deformable.rope_drawing import CAMERAS, POLE_ID, ROPE_ID, Tube


def first_frame(**factors):
    spec = EpisodeSpec("push_rope", "train", 8, factors=factors)
    return PushRope().reset(options={"spec": spec})


@pytest.mark.parametrize("camera", list(CAMERAS))
def test_the_mask_shows_rope_and_pole_where_they_are(camera):
    _, info = first_frame(camera=camera)
    mask, state = info["mask"], info["state"]
    nodes = np.column_stack([state["rope_position"], np.full(80, 0.06)])
    columns, rows = CAMERAS[camera].project(nodes, 240, 240)[:, :2].astype(int).T
    shown = mask[rows, columns]
    assert np.isin(shown, (ROPE_ID, POLE_ID)).mean() > 0.97
    assert (shown == ROPE_ID).mean() > 0.7
    assert 0.01 < (mask == ROPE_ID).mean() < 0.06
    foot = np.array([[*state["pole_position"], 0.16]])
    column, row = CAMERAS[camera].project(foot, 240, 240)[0, :2].astype(int)
    assert mask[row, column] == POLE_ID


def test_the_rope_is_striped_in_its_colours():
    frame, info = first_frame()
    red, blue = (frame[info["mask"] == ROPE_ID].astype(int)[:, k] for k in (0, 2))
    assert 0.35 < np.mean(red - blue > 90) < 0.75  # red stripes; the others are cream
    floor = frame[info["mask"] == 0].astype(int)
    assert np.ptp(floor.mean(0)) < 20  # on neutral ground


def test_the_surface_lies_a_radius_from_the_curve():
    cord = Cord(2.37)
    nodes = lay_rope(cord, np.random.default_rng(0)).nodes
    tube = Tube(cord)
    vertices, normals = tube.around(nodes)
    assert tube.stripes == 24
    fine = np.concatenate(
        [nodes[:-1] + share * np.diff(nodes, axis=0) for share in np.linspace(0, 1, 20)]
    )
    spots = np.column_stack([fine, np.full(len(fine), cord.radius)])
    flat = vertices.reshape(-1, 3)
    away = np.array([np.linalg.norm(spots - v, axis=1).min() for v in flat])
    np.testing.assert_allclose(away, cord.radius, rtol=0.04)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-6)
    # Neighbouring stripes meet: no gap between them.
    np.testing.assert_allclose(vertices[:-1, -7:], vertices[1:, :7], atol=1e-9)
