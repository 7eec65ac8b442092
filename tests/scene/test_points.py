"""Points that nobody declared: learnt from pictures and actions, they are where things are."""

from types import SimpleNamespace

import pytest
import torch

from acwm_core.checks import check_model
from acwm_core.errors import RecipeError
from acwm_core.plugins import catalog
from acwm_scene.declared import GroupSpec
from acwm_scene.point_motion import PointMotion
from acwm_scene.point_sight import PointSight
from acwm_scene.point_training import learn_points, states_with_points
from acwm_scene.scene import SceneDynamics
from tests.scene.dots import follow, learn_motion, world_of

SMALL = {"latent_channels": 3, "temporal_stride": 1, "channels": 24, "width": 16, "blocks": 1}
FRAMES, CELLS = 9, 8


def balls(clips, seed):
    """A ball that actions move over a patterned ground, and one that rests.

    Returns:
        Latents `[B, T, 3, 8, 8]`, places of the ball `[B, T, 2]`, and actions `[B, T, 2]`.
    """
    random = torch.Generator().manual_seed(seed)
    actions = torch.rand(clips, FRAMES, 2, generator=random).mul(0.6).sub(0.3)
    place = torch.rand(clips, 2, generator=random).mul(1.2).sub(0.6)
    places = [place]
    for action in actions[:, :-1].unbind(1):
        place = (place + action).clamp(-0.8, 0.8)
        places.append(place)
    places = torch.stack(places, 1)
    rests = torch.rand(clips, 1, 2, generator=random).mul(1.6).sub(0.8).expand(-1, FRAMES, -1)
    ground = torch.randn(3, CELLS, CELLS, generator=torch.Generator().manual_seed(0))
    sides = (2 * torch.arange(CELLS) + 1) / CELLS - 1
    cells = torch.stack(torch.meshgrid(sides, sides, indexing="xy"), -1).flatten(0, 1)
    colours = torch.tensor([[3.0, 0, 0], [0, -3.0, 3.0]])
    latents = ground.flatten(1).expand(clips, FRAMES, -1, -1)
    for ball, colour in zip((rests, places), colours, strict=True):
        cover = torch.exp(-20 * (ball[:, :, None] - cells).square().sum(-1))[:, :, None]
        latents = latents * (1 - cover) + cover * colour[:, None]
    return latents.unflatten(3, (CELLS, CELLS)), places, actions


def clips_of(latents, states=None):
    states = latents.new_zeros(*latents.shape[:2], 0) if states is None else states
    return SimpleNamespace(
        seed=0, shows_progress=False, states=states, latents=lambda rows: latents[rows]
    )


def model_of_balls(**parameters):
    torch.manual_seed(0)
    return SceneDynamics(**{"specs": {}, "state_size": 0, "points": 4} | SMALL | parameters)


@pytest.fixture(scope="module")
def learnt():
    model = model_of_balls()
    latents, _, actions = balls(256, seed=1)
    learn_points(model, clips := clips_of(latents), 110)
    world = world_of(model, stride=1, states=4)
    learn_motion(world, states_with_points(model, clips), actions, steps=400, clips=32)
    return world


def explained(points, places):
    """The share of the variance of places that follows linearly from points, of test clips."""
    inputs = torch.cat([points, torch.ones_like(points[:, :1])], 1)
    half = len(inputs) // 2
    fitted = torch.linalg.lstsq(inputs[:half], places[:half]).solution
    error = (inputs[half:] @ fitted - places[half:]).square().mean()
    return 1 - error / places[half:].var()


@torch.no_grad()
@pytest.mark.ci
def test_points_tell_where_things_are(learnt):
    latents, places, _ = balls(64, seed=2)
    points = learnt.model.points.sight(latents.flatten(0, 1))[..., :2].flatten(1)
    assert explained(points, places.flatten(0, 1)) > 0.9


@torch.no_grad()
@pytest.mark.ci
def test_a_frame_is_drawn_from_its_points_alone(learnt):
    model = learnt.model.eval()
    latents, _, _ = balls(64, seed=3)
    states = model.with_points(latents.new_zeros(64, FRAMES, 0), latents)
    drawn = model.draw_true(latents[:, :1], states, torch.arange(FRAMES - 1).expand(64, -1))
    error = (drawn - latents[:, 1:]).square().mean()
    still = (latents[:, :1] - latents[:, 1:]).square().mean()
    assert error < 0.2 * still


@torch.no_grad()
@pytest.mark.ci
def test_actions_move_them(learnt):
    latents, _, actions = balls(64, seed=4)
    true = states_with_points(learnt.model, clips_of(latents))
    moved = follow(learnt, true, actions)["points"].flatten(2)
    error, still = ((each[:, -1] - true[:, -1]).square().mean() for each in (moved, true[:, :1]))
    assert error < 0.3 * still


def test_declared_states_are_learnt_beside_points_if_they_are_named():
    card = catalog().component("environment", "push_cube").load().card
    changing = [field.name for field in card.state]
    assert SceneDynamics.default_states(card, changing)
    assert SceneDynamics.default_states(card, changing, points=4) == ()


def test_declared_states_keep_their_columns():
    spec = GroupSpec("values", (0, 1))
    model = model_of_balls(specs={"values": spec}, state_size=2)
    model.prepare(torch.zeros(2), torch.ones(2))
    latents, places, _ = balls(3, seed=0)
    states = model.with_points(places, latents)
    assert states.shape == (3, FRAMES, 2 + model.point_size)
    torch.testing.assert_close(model.decode(model.encode(states)), places)


def test_points_of_a_latent_frame_are_those_of_all_its_video_frames():
    model = model_of_balls(temporal_stride=4)
    latents, _, _ = balls(2, seed=0)
    states = model.with_points(latents.new_zeros(2, 33, 0), latents)
    read = model.points.sight(latents[:, 2]).flatten(1)
    torch.testing.assert_close(states[:, 5:9], read[:, None].expand(-1, 4, -1))


def test_the_average_frame_is_kept_exactly():
    sight, average = PointSight(3, 2, 1), torch.randn(3, 16, 8)
    sight.measure(average)
    kept = torch.nn.functional.adaptive_avg_pool2d(sight.average, (16, 8))
    torch.testing.assert_close(kept, average)


@pytest.mark.parametrize("noise", [0, 2])
def test_a_scene_with_points_conforms(noise):
    def built(*, latent_channels):
        sizes = SMALL | {"latent_channels": latent_channels}
        return SceneDynamics(**sizes, specs={}, state_size=0, points=3, noise=noise)

    results = [*check_model(built)]
    assert [(each.name, each.reason) for each in results if not each.passed] == []


def test_a_scene_of_nothing_is_refused():
    with pytest.raises(RecipeError, match=r"model.points=16"):
        SceneDynamics(latent_channels=3, specs={}, state_size=0)


@pytest.mark.ci
def test_points_move_with_regard_to_what_is_declared():
    """A declared value alone decides where the point goes; the actions do not tell."""
    torch.manual_seed(0)
    declared = {"values": GroupSpec("values", columns=(0,))}
    model = model_of_balls(specs=declared, state_size=1, points=1)
    model.prepare(torch.zeros(1), torch.ones(1))
    values = torch.cumsum(torch.randn(128, FRAMES, 1) * 0.3, 1)
    place = torch.zeros(128, FRAMES, 6)
    place[..., 0] = 0.5 * (values - values[:, :1])[..., 0]
    model.points.measure(place.flatten(0, 1)[:, None], torch.ones(1, 6))
    world, states = world_of(model, stride=1, states=7), torch.cat([values, place], 2)
    learn_motion(world, states, torch.zeros(128, FRAMES, 2), steps=400, clips=32)
    actions = model.points.embed(torch.zeros(128, FRAMES, SMALL["width"]))
    beside = model.points.with_declared(actions, model.encode(states)["values"][:, 1:])
    state = model.points.begin(place[:, :1], place[:, :1])
    for frame in range(1, FRAMES):
        state, _ = model.points.move(state, beside[:, frame])
    error = (state.points[:, 0, 0] - place[:, -1, 0]).square().mean()
    assert error < 0.3 * place[:, -1, 0].square().mean()


def test_points_that_push_one_another_ever_further_stay_near_the_picture():
    """They did not: over long windows, errors grew a hundredfold, and motion was never learnt."""
    torch.manual_seed(0)
    motion = PointMotion(points=3, features=1, width=4)
    motion.push[-1].bias.data.fill_(5.0)
    state = motion.begin(torch.zeros(2, 3, 3), torch.zeros(2, 3, 3))
    for _ in range(20):
        state = motion(torch.zeros(2, 32), state)
    assert 1 < state.points.max() < 1.3
    state.points.sum().backward()
    assert motion.push[-1].bias.grad.abs().min() > 0, "what is too far is called back"
