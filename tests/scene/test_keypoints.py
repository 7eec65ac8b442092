"""Where a scene sees its things: learnt points as they are, declared ones by the camera."""

import math

import pytest
import torch

from acwm_core.env.camera import Camera
from acwm_core.errors import RecipeError
from acwm_core.model.dynamics import LatentStream
from acwm_scene.declared import GroupSpec
from acwm_scene.scene import SceneDynamics
from tests.scene.dots import world_of
from tests.scene.test_points import FRAMES, balls, model_of_balls

CAMERA = Camera((0.0, -1.0, 2.0))


class Still(LatentStream):
    def advance(self, conditioning):
        raise NotImplementedError


def bodies(**parameters):
    spec = GroupSpec("bodies", tuple(range(8)), agents=1, bodies=2, camera=CAMERA)
    torch.manual_seed(0)
    sizes = {"latent_channels": 2, "channels": 8, "width": 4, "blocks": 1, "temporal_stride": 1}
    return SceneDynamics(specs={"bodies": spec}, state_size=8, **sizes, **parameters).eval()


def test_points_are_those_that_it_reads_and_moves():
    model = model_of_balls(temporal_stride=2).eval()
    world = world_of(model, stride=2, states=0)
    latents, _, _ = balls(2, seed=0)
    read = model.read_keypoints(latents)
    assert world.keypoint_names == ("point 1", "point 2", "point 3", "point 4")
    torch.testing.assert_close(read.values[:, 3], model.points.sight(latents[:, 3]))
    actions = torch.rand(2, 2 * FRAMES - 1, 2)
    with torch.no_grad():
        conditioning = world.condition(actions, FRAMES)
        moved = model.predict_keypoints(latents[:, :1], conditioning, FRAMES)
        assert moved.values.shape == read.values[:, 1:].shape
        state, rows = model.points.read(latents[:, :1]), model.embed(conditioning)["points"]
        for row in rows[:, 1:3].unbind(1):
            state, _ = model.points.move(state, row)
    torch.testing.assert_close(moved.values[:, 1], state.points)


@torch.no_grad()
def test_a_moved_point_continues_from_its_new_place():
    model = model_of_balls(temporal_stride=2).eval()
    world = world_of(model, stride=2, states=0)
    latents, _, _ = balls(2, seed=0)
    conditioning = world.condition(torch.rand(2, 2 * FRAMES - 1, 2), FRAMES)
    streams = [model.stream(latents[:, :1], context=2) for _ in range(2)]
    before = streams[0].keypoints().values
    streams[1].move_keypoint(1, torch.tensor([0.5, -0.5]))
    moved = streams[1].keypoints().values
    torch.testing.assert_close(moved[:, 0, 1, :2], torch.tensor([[0.5, -0.5]] * 2))
    assert moved[:, :, [0, 2, 3]].equal(before[:, :, [0, 2, 3]])
    assert moved[:, :, 1, 2:].equal(before[:, :, 1, 2:])
    for stream in streams:
        stream.advance(conditioning.frames(0, 2))
    later = [stream.keypoints().values[:, 0, 1, :2] for stream in streams]
    torch.testing.assert_close(later[1] - later[0], (moved - before)[:, 0, 1, :2], atol=0.1, rtol=0)


def test_what_a_stream_cannot_move_is_refused():
    scene = bodies().stream(torch.randn(1, 1, 2, 6, 12), context=2)
    assert scene.keypoints() is None
    with pytest.raises(RecipeError, match="cannot move things"):
        Still().move_keypoint(0, torch.zeros(2))


def test_a_share_is_what_drawing_cares_for():
    model = model_of_balls()
    costs = torch.zeros(4, 6)
    costs[0], costs[1, 0] = 2.0, 1.0
    model.points.measure(torch.randn(64, 4, 6, generator=torch.Generator().manual_seed(0)), costs)
    found = model.points.keypoints(torch.zeros(1, 1, 4, 6), 1.0)
    torch.testing.assert_close(found.shares, torch.tensor([1, 1 / math.sqrt(24), 0, 0]))
    assert found.weights[2:].eq(0).all()


@torch.no_grad()
def test_declared_bodies_are_where_the_camera_sees_them():
    model = bodies()
    world = world_of(model, stride=1, states=8)
    given, actions = torch.randn(1, 1, 2, 6, 12), torch.rand(3, 5, 2)
    conditioning = world.condition(actions, 5)
    states = model.predict_states(given, conditioning, 5)
    found = model.predict_keypoints(given, conditioning, 5)
    assert model.keypoint_names == ("agent 1", "body 1", "body 2")
    places = torch.cat([states[..., :6].unflatten(2, (3, 2)), torch.zeros(3, 4, 3, 1)], -1)
    seen = torch.as_tensor(CAMERA.to_frame(places))[..., :2]  # in heights of the frame
    torch.testing.assert_close(found.values, 2 * seen / torch.tensor([2.0, 1.0]))


@torch.no_grad()
def test_learnt_points_stand_beside_declared_bodies():
    model = bodies(points=2)
    found = model.read_keypoints(torch.randn(2, 3, 2, 6, 6))
    assert found.values.shape == (2, 3, 5, 6)
    assert model.keypoint_names == ("agent 1", "body 1", "body 2", "point 1", "point 2")
    assert found.weights[:3, 2:].eq(0).all()
    assert found.shares.shape == (5,)


def test_values_have_no_place():
    model = SceneDynamics(latent_channels=2, state_size=3, channels=8, width=4, blocks=1)
    world = world_of(model, states=3)
    assert world.keypoint_names == ()
    with pytest.raises(RecipeError, match="sees no keypoints"):
        world.read_keypoints(torch.rand(1, 1, 3, 8, 8))
