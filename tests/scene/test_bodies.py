"""Bodies on a plane: poses are read, moved and drawn, each learnt from the truth of the others."""

import math

import numpy as np
import pytest
import torch
from torch.nn import functional

from acwm_core.checks import check_model
from acwm_scene.bodies import BodyGroup
from acwm_scene.body_motion import ACTION, HIDDEN, BodyMotion, Moving
from acwm_scene.body_windows import HORIZONS, moving_windows
from acwm_scene.declared import GroupSpec
from acwm_scene.group import at_frame
from acwm_scene.objective import SceneObjective
from acwm_scene.poses import Poses, turned, turned_back
from acwm_scene.scene import SceneDynamics
from tests.scene.dots import learn_motion, world_of
from tests.scene.mechanics import SMALL, model_of_pucks, pucks, spec_of


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


def test_poses_are_states_as_they_were_recorded():
    """But for heights, which nobody knows, and of angles that look the same the smallest."""
    states = torch.tensor([[[0.1, -0.2, 1, 0, 0.3, 0.4, 9.0, 0, 0, 9.0, math.pi / 8, 2.0]]])
    group = group_of()
    decoded = group.decode(group.encode(states))
    assert decoded[0, 0, [6, 9]].isnan().all()
    states[0, 0, [6, 9]], states[0, 0, 11] = math.nan, 2.0 - math.pi / 2
    torch.testing.assert_close(decoded, states, equal_nan=True)


@pytest.mark.parametrize("there", [[[0, 0]], [[0, 1]], [[1, 0], [0, 0]], [[1, 0], [0, 1]]])
@pytest.mark.parametrize("noise", [0, 3])
def test_bodies_that_are_in_no_scene_are_left_out_and_stay_as_they_were(there, noise, monkeypatch):
    torch.manual_seed(0)
    group = next(model_of_pucks(noise=noise).groups.children()).eval()
    for parameter in group.parameters():
        torch.nn.init.normal_(parameter, std=0.1)
    scenes = len(there)
    turns = torch.nn.functional.normalize(torch.randn(scenes, 2, 2), dim=-1)
    poses = Poses(torch.randn(scenes, 1, 2), torch.tensor(there)[..., None].float(), *[turns] * 2)
    change = torch.randn(scenes, 2, 2) * poses.present
    state = group._begun(poses, torch.zeros(scenes, 1, 2), change, 0 * change[..., :1])
    if noise:
        state = group.with_draw(state, torch.randn(scenes, 2 * noise))
    actions, moved = torch.randn(scenes, 1, 1, ACTION), []
    monkeypatch.setattr(
        group.body_motion,
        "forward",
        lambda moving, agents, motion=group.body_motion.forward: (
            moved.append(moving.poses.places.shape[1]) or motion(moving, agents)
        ),
    )
    for _ in range(2):
        whole = group.move(state, actions)
        with torch.no_grad():
            less = group.move(state, actions)
        torch.testing.assert_close(less, whole)
        state = less[0]
    some = [*map(any, zip(*there, strict=True))]
    assert moved == [2, sum(some)] * 2


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


@pytest.mark.ci
def test_it_draws_what_cannot_be_known(monkeypatch):
    """Pushes reach as far as chance has it: draws differ where pucks do, and about as much."""
    monkeypatch.setattr("acwm_scene.body_windows.FRAMES", 384)
    reaches = np.random.default_rng(5)

    def clips(number, seed):
        reach = reaches.uniform(0.5, 1.5, (number, 2, 1))
        return pucks(number, seed, reach=reach)

    model = model_of_pucks(channels=48, noise=2)
    world = world_of(model, stride=1, states=10)
    learn_motion(world, *clips(256, 0))
    truths = [model.encode(clips(32, 1)[0])["bodies"] for _ in range(16)]
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


@pytest.mark.ci
def test_it_finds_what_a_picture_shows():
    """A dot that is drawn at an agent's place, in a channel of its own, and one for each body."""
    torch.manual_seed(0)
    model = model_of_pucks(latent_channels=3)
    (group,) = model.groups.children()
    optimizer = torch.optim.AdamW(group.sight.parameters(), 6e-3)
    cells = group._cells(torch.Size([8, 8]))

    def pictures(clips, seed):
        states, _ = pucks(clips, seed, frames=2)
        true = model.encode(states)["bodies"]
        things = torch.cat([true.agents, true.places], 2)[:, 0]
        return torch.exp(-(things[:, :, None] - cells).square().sum(-1)).unflatten(
            2, (8, 8)
        ), things

    for step in range(80):
        frames, things = pictures(32, step)
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
