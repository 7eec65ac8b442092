"""Bodies on a plane: poses are read, moved and drawn, each learnt from the truth of the others."""

import math

import numpy as np
import pytest
import torch
from torch.nn import functional

from acwm_core.checks import check_model
from acwm_core.env.camera import Camera
from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.conditioner import Conditioning
from acwm_scene.bodies import BodyGroup
from acwm_scene.body_motion import HIDDEN, BodyMotion, Moving
from acwm_scene.body_windows import HORIZONS, moving_windows
from acwm_scene.declared import GroupSpec
from acwm_scene.group import at_frame
from acwm_scene.objective import SceneObjective
from acwm_scene.poses import Poses, turned, turned_back
from acwm_scene.scene import SceneDynamics
from tests.scene.dots import follow, learn_motion, world_of

SMALL = {"channels": 16, "width": 32, "blocks": 1}
REACH = 1.0
"""Distance in units below which an agent pushes a puck."""


def pucks(clips, seed, frames=17, bodies=2, reach=REACH):
    """Agents that go where they are told, and pucks that they push straight away; as states.

    A push leaves a puck at the distance `reach` behind which it was met, so that all that happens
    follows from simple geometry.
    """
    random = np.random.default_rng(seed)
    actions = random.uniform(-1, 1, (clips, frames, 2)).astype(np.float32).repeat(4, 1)[:, :frames]
    agent = np.zeros((clips, frames, 2))
    place = np.zeros((clips, frames, bodies, 2))
    agent[:, 0] = random.uniform(-3, 3, (clips, 2))
    place[:, 0] = random.uniform(-2, 2, (clips, bodies, 2))
    for now in range(1, frames):
        goal = 3 * actions[:, now - 1]
        agent[:, now] = agent[:, now - 1] + 0.3 * (goal - agent[:, now - 1])
        apart = place[:, now - 1] - agent[:, now, None]
        far = np.linalg.norm(apart, axis=-1, keepdims=True).clip(1e-6)
        pushed = agent[:, now, None] + apart / far * reach
        place[:, now] = np.where(far < reach, pushed, place[:, now - 1])
    present = np.ones((clips, frames, bodies))
    angles = np.zeros((clips, frames, bodies))
    parts = [agent, present, place.reshape(clips, frames, -1), angles]
    return torch.tensor(np.concatenate(parts, -1), dtype=torch.float32), torch.tensor(actions)


ABOVE = Camera((0.0, 0.0, 4.0), up=(0.0, 1.0, 0.0), fov=90.0)
"""A camera that sees 4 m from the middle of the picture to its upper edge."""


def spec_of(agents=1, bodies=2, folds=4, axes=2):
    size = 2 * agents + bodies * (axes + 2)
    counts = {"agents": agents, "bodies": bodies, "folds": folds, "axes": axes}
    return GroupSpec("bodies", tuple(range(size)), **counts, has_presence=True, camera=ABOVE)


def model_of_pucks(**parameters):
    asked = {"latent_channels": 2, "temporal_stride": 1, "unit": 1.0}
    specs = {"specs": {"bodies": spec_of()}, "state_size": 10}
    return SceneDynamics(**asked | specs | SMALL | parameters)


def group_of(axes=3, unit=0.1):
    sizes = {"latent_channels": 2, "stride": 1, "channels": 8, "width": 8}
    return BodyGroup(spec_of(axes=axes), **sizes, unit=unit)


def test_states_are_poses_in_units():
    """Two cubes, the second one absent, with z among their coordinates."""
    states = torch.tensor([[[0.1, -0.2, 1, 0, 0.3, 0.4, 9.0, 0, 0, 9.0, math.pi / 8, 0.0]]])
    poses = group_of().encode(states)
    torch.testing.assert_close(poses.agents, torch.tensor([[[[1.0, -2.0]]]]))
    torch.testing.assert_close(poses.places[0, 0, 0], torch.tensor([3.0, 4.0]))
    torch.testing.assert_close(poses.turns[0, 0], torch.tensor([[0.0, 1.0], [1.0, 0.0]]))
    assert poses.present[0, 0, :, 0].tolist() == [1, 0]
    with pytest.raises(ShapeError, match="9 values, not 10"):
        model_of_pucks().encode(states[..., :9])
    with pytest.raises(RecipeError, match="must be at least 1"):
        model_of_pucks(blocks=0)


def test_poses_are_states_as_they_were_recorded():
    """But for heights, which nobody knows, and of angles that look the same the smallest."""
    states = torch.tensor([[[0.1, -0.2, 1, 0, 0.3, 0.4, 9.0, 0, 0, 9.0, math.pi / 8, 2.0]]])
    group = group_of()
    decoded = group.decode(group.encode(states))
    assert decoded[0, 0, [6, 9]].isnan().all()
    states[0, 0, [6, 9]], states[0, 0, 11] = math.nan, 2.0 - math.pi / 2
    torch.testing.assert_close(decoded, states, equal_nan=True)


@pytest.mark.parametrize("noise", [0, 3])
def test_it_draws_the_states_that_it_predicts(noise):
    """With these as true ones, it draws the same pictures, of the same draw."""
    torch.manual_seed(0)
    model = model_of_pucks(noise=noise).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    given = torch.randn(1, 1, 2, 8, 8)
    clips = Conditioning(torch.randn(3, 6, model.width), None, None)

    def generators():
        return [torch.Generator().manual_seed(seed) for seed in range(3)]

    with torch.no_grad():
        states = model.predict_states(given, clips, 6, generators())
        given = given.expand(3, -1, -1, -1, -1)
        own = model(given, clips, 6, generators())
        (group,) = model.groups.children()
        first = group.decode(Poses(*(each[:, None] for each in group.frame(group.read(given)))))
        numbers = torch.arange(5).expand(3, -1)
        drawn = model.draw_true(given, torch.cat([first, states], 1), numbers)
    torch.testing.assert_close(drawn, own, atol=1e-4, rtol=1e-3)


def test_a_body_moves_alike_in_any_frame_and_feels_none_that_is_not_there():
    """Where a frame looks from makes no difference: only walls are tied to the plane."""
    torch.manual_seed(0)
    motion = BodyMotion(16, folds=4)
    torch.nn.init.normal_(motion.out.weight)
    with torch.no_grad():
        motion.own.weight[:, 1:5] = 0  # what tells of the place and the heading
        motion.own.weight[:, 8:-1] = 0
    angles = torch.rand(1, 3) * 0.2
    places = torch.randn(1, 3, 2)
    there = torch.tensor([1.0, 1.0, 0.0])[None, :, None]
    still = torch.zeros(1, 3, 2), torch.zeros(1, 3, 1)

    def moved(by, *, third=0.0):
        turn = torch.tensor([math.cos(by), math.sin(by)])
        here = places + third * torch.tensor([0.0, 0.0, 1.0])[None, :, None]
        poses = Poses(
            turned(torch.ones(1, 1, 2), turn),
            there,
            turned(here, turn),
            torch.stack([(4 * (angles + by)).cos(), (4 * (angles + by)).sin()], -1),
        )
        moving = Moving(poses, torch.zeros(1, 1, 2), torch.zeros(1, 1, HIDDEN), *still)
        moved = motion(moving, turned(torch.tensor([[[1.2, 0.9]]]), turn))
        return turned_back(moved.place_change, turn)

    first = moved(0.0)
    assert first[0, :2].abs().min() > 0
    assert first[0, 2].abs().max() == 0
    torch.testing.assert_close(first, moved(0.5), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(first, moved(0.0, third=3.0))


def learned(model, states, actions):
    """A world model that has learned motion for two hundred steps."""
    world = world_of(model, stride=1, states=10)
    learn_motion(world, states, actions)
    return world


@pytest.mark.ci
def test_it_learns_how_agents_push_bodies():
    """Two hundred steps on short windows foretell whole clips of a simple mechanics."""
    model = model_of_pucks(channels=48)
    world = learned(model, *pucks(256, seed=0))
    states, actions = pucks(64, seed=1)
    true = model.encode(states)["bodies"].places
    made = follow(world, states, actions)["bodies"].places
    moved = (true[:, -1] - true[:, 0]).norm(dim=-1)
    assert moved.mean() > 0.3
    assert (made[:, -1] - true[:, -1]).norm(dim=-1).mean() < 0.6 * moved.mean()


@pytest.mark.ci
def test_it_draws_what_cannot_be_known():
    """Pushes reach as far as chance has it: draws differ where pucks do, and as much."""
    reaches = np.random.default_rng(5)
    model = model_of_pucks(channels=48, noise=2)
    learned(model, *pucks(256, seed=0, reach=reaches.uniform(0.5, 1.5, (256, 2, 1))))
    chances = [reaches.uniform(0.5, 1.5, (32, 2, 1)) for _ in range(16)]
    truths = [model.encode(pucks(32, seed=1, reach=each)[0])["bodies"] for each in chances]
    (group,), random = model.groups.children(), torch.Generator().manual_seed(0)
    start, path = at_frame(truths[0], 0), truths[0].agents[:, 1:]
    begun = group.begin(start, start)

    def drawn():
        made = group._pushed(begun._replace(chance=(group._chance(start, random),)), path)
        return made.places[:, -1]

    with torch.no_grad():
        draws = torch.stack([drawn() for _ in truths])
    true = torch.stack([each.places[:, -1] for each in truths])
    doubt, spread = (each.var(0).sum(-1).sqrt() for each in (true, draws))
    assert doubt.mean() > 0.2
    assert 0.7 < spread[doubt > 0.1].mean() / doubt[doubt > 0.1].mean() < 1.4
    assert spread[doubt < 0.01].mean() < 0.3 * spread[doubt > 0.1].mean()
    one, mean = ((each - true).norm(dim=-1).mean() for each in (draws, draws.mean(0)))
    assert mean < one


def test_one_that_draws_conforms_and_learns_pictures_by_squared_error():
    def drawing(*, latent_channels):
        scene = {"specs": {"bodies": spec_of(bodies=5)}, "state_size": 22, "noise": 2}
        return SceneDynamics(latent_channels=latent_channels, **scene, **SMALL)

    results = [*check_model(drawing)]
    assert [each.name for each in results if not each.passed] == []
    tried = {each.name for each in results if not each.reason}
    assert {"draws from the generators if it says so", "streams what it predicts"} <= tried
    SceneObjective().check_model(drawing(latent_channels=3))


def test_windows_are_of_what_moves():
    states, _ = pucks(64, seed=3)
    true = model_of_pucks().encode(states)["bodies"]
    random = torch.Generator().manual_seed(0)
    for progress, horizon in ((0.0, HORIZONS[0][1]), (1.0, 16)):
        window, (change, spin) = moving_windows(true, random, progress, folds=4)
        assert window.places.shape[1] == horizon + 1
        moves = window.places.diff(dim=1).abs().sum((1, 2, 3)) > 0
        assert moves.float().mean() > 0.6
        assert spin.abs().max() == 0
    whole = (true.places[:, 0] - window.places[:1, 0]).abs().sum((1, 2)).argmin()
    torch.testing.assert_close(window.places[0], true.places[whole])
    assert change[0].abs().max() == 0  # before the first frame, everything stands


def test_it_draws_true_states_and_learns_nothing_of_motion_by_it():
    torch.manual_seed(0)
    model = model_of_pucks()
    torch.nn.init.normal_(model.drawing.out.weight)
    states, _ = pucks(2, seed=0)
    given = torch.randn(2, 1, 2, 8, 8)
    numbers = torch.arange(16).expand(2, -1)
    drawn = model.draw_true(given, states, numbers)
    drawn.square().mean().backward()
    (group,) = model.groups.children()
    idle = [*group.sight.parameters(), *model.motion_parameters()]
    assert all(each.grad is None for each in idle)
    other = states.clone()
    other[:, 9, :2] += 1
    changed = (model.draw_true(given, other, numbers) - drawn).abs().amax((0, 2, 3, 4))
    assert changed.nonzero().flatten().tolist() == [8]  # frame 9 is the 9th after the given one
    with pytest.raises(RecipeError, match="conditioner=adaln"):
        model(given, Conditioning(None, None, None), 17)
    with pytest.raises(ShapeError, match="takes latents"):
        model.read(given[:, :, :1])


@pytest.mark.ci
def test_it_finds_what_a_picture_shows():
    """A dot that is drawn at an agent's place, in a channel of its own, and one for each body."""
    torch.manual_seed(0)
    model = model_of_pucks(latent_channels=3)
    (group,) = model.groups.children()
    optimizer = torch.optim.AdamW(group.sight.parameters(), 3e-3)
    cells = group._cells(torch.Size([8, 8]))

    def pictures(clips, seed):
        states, _ = pucks(clips, seed, frames=2)
        true = model.encode(states)["bodies"]
        things = torch.cat([true.agents, true.places], 2)[:, 0]
        return torch.exp(-(things[:, :, None] - cells).square().sum(-1)).unflatten(
            2, (8, 8)
        ), things

    for step in range(150):
        frames, things = pictures(64, step)
        seen, _ = group.sight(frames, cells)
        optimizer.zero_grad()
        functional.mse_loss(torch.cat([seen.agents, seen.places], 1), things).backward()
        optimizer.step()
    frames, things = pictures(64, 1000)
    seen, _ = group.sight(frames, cells)
    assert (torch.cat([seen.agents, seen.places], 1) - things).norm(dim=-1).mean() < 0.3


def test_two_given_frames_tell_how_things_move():
    torch.manual_seed(0)
    model = model_of_pucks(latent_channels=3).eval()
    moving = model.read(torch.randn(1, 2, 3, 8, 8)).states["bodies"]
    still = model.read(torch.randn(1, 1, 3, 8, 8)).states["bodies"]
    assert moving.place_change.abs().min() > 0
    assert still.place_change.abs().max() == still.spin.abs().max() == 0


@pytest.mark.ci
def test_groups_combine():
    """Joints as values and pucks as bodies, in one scene: all that the suite asks of a model."""
    values = GroupSpec("values", (10, 11, 12), following=1)
    specs = {"bodies": spec_of(), "values": values}

    def combined(*, latent_channels):
        sizes = SMALL | {"specs": specs, "state_size": 13}
        model = SceneDynamics(latent_channels=latent_channels, **sizes)
        model.prepare(torch.zeros(13), torch.ones(13))
        return model

    results = {each.name: each for each in check_model(combined)}
    for name in ("streams what it predicts", "predicts states of every frame"):
        assert results[name].passed, results[name].reason
        assert not results[name].reason
    model, states = combined(latent_channels=2), torch.randn(2, 5, 13)
    decoded = model.decode(model.encode(states))
    torch.testing.assert_close(decoded[..., 10:], states[..., 10:])
    torch.testing.assert_close(decoded[..., :2], states[..., :2])
