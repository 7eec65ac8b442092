"""A scene that is carried as its states: they are read, moved and drawn, each from the truth."""

import pytest
import torch
from torch.nn import functional

from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_scene.declared import GroupSpec
from acwm_scene.scene import SceneDynamics
from acwm_scene.value_layers import ValueSight
from tests.scene.dots import world_of
from tests.scene.mechanics import FRAMES, arms, model_of_arms


def test_of_long_clips_a_step_moves_fewer(monkeypatch):
    """A step costs no more than it did, however long episodes are."""
    world = world_of(model_of_arms(), stride=1, states=4)
    states, actions = arms(8, seed=0)

    def loss(clips):
        random = torch.Generator().manual_seed(0)
        conditioning = world.condition(actions[:clips], FRAMES)
        return world.model.motion_loss(states[:clips], conditioning, random, progress=1)

    monkeypatch.setattr("acwm_scene.values.START_NOISE", 0.0)
    few = loss(3)
    assert abs(loss(8) - few) > 1e-3
    monkeypatch.setattr("acwm_scene.values.MOVED_FRAMES", 3 * (FRAMES - 1))
    torch.testing.assert_close(loss(8), few)


@pytest.mark.ci
def test_it_reads_what_a_picture_shows():
    """A dot in a channel of its own for each of two places; the states are where they are."""
    torch.manual_seed(0)
    sight = ValueSight(2, 4, 16)
    optimizer = torch.optim.AdamW(sight.parameters(), 6e-3)
    sides = torch.linspace(-1, 1, 8)
    cells = torch.stack(torch.meshgrid(sides, sides, indexing="ij"), -1).flatten(0, 1)

    def pictures(clips, seed):
        random = torch.Generator().manual_seed(seed)
        places = torch.rand(clips, 2, 2, generator=random).mul(1.6).sub(0.8)
        apart = (places[:, :, None] - cells).square().sum(-1)
        return torch.exp(-10 * apart).unflatten(2, (8, 8)), places.flatten(1)

    for step in range(80):
        frames, places = pictures(32, step)
        optimizer.zero_grad()
        functional.mse_loss(sight(frames), places).backward()
        optimizer.step()
    frames, places = pictures(64, 1000)
    with torch.no_grad():
        assert (sight(frames) - places).abs().mean() < 0.06


def test_it_learns_to_draw_states_as_wrong_as_it_reads_them():
    """All along as wrong as in the given frame; the hand is where these angles lead it."""
    torch.manual_seed(0)
    model = model_of_arms(following=2)
    states, _ = arms(8, seed=0)
    given = torch.randn(8, 1, 3, 8, 8)
    (group,) = model.groups.children()
    with torch.no_grad():
        course = group.train().as_read(given[:, 0], states)
        wrong = group.sight(given[:, 0])[:, :2] - states[:, 0, :2]
        angles, hands = course.split(2, -1)
        assert (angles - states[..., :2] - wrong[:, None]).abs().mean() < 0.03 < wrong.abs().mean()
        led, leads = group.motion.follow(angles), group.motion.follow(states[..., :2])
        assert (hands - states[..., 2:] - (led - leads)).abs().mean() < 0.03
        torch.testing.assert_close(group.eval().as_read(given[:, 0], states), states)


def test_values_are_scaled_and_angles_wrap():
    """A model of raw values would have to know what a radian is beside a metre."""
    model = model_of_arms(angles=(1,))
    (group,) = model.groups.children()
    mean, std = torch.tensor([1.0, 2.0, 3.0, 4.0]), torch.tensor([2.0, 2.0, 4.0, 4.0])
    group.prepare(mean, std)
    states = mean + std * torch.randn(2, 5, 4)
    values = group.encode(states)
    assert values.shape == (2, 5, 5)
    torch.testing.assert_close(values[..., 0], (states[..., 0] - 1) / 2)
    torch.testing.assert_close(values[..., 1], states[..., 1].cos())
    turned = states + 2 * torch.pi * torch.tensor([0.0, 1.0, 0.0, 0.0])
    torch.testing.assert_close(group.encode(turned), values, atol=1e-5, rtol=1e-4)
    wrapped = torch.remainder(states[..., 1] + torch.pi, 2 * torch.pi) - torch.pi
    states = torch.cat([states[..., :1], wrapped[..., None], states[..., 2:]], -1)
    torch.testing.assert_close(group.decode(values), states, atol=1e-4, rtol=1e-4)


def test_a_scale_that_is_known_stays():
    """Weights of another training say what their numbers mean, whatever data comes after."""
    model = model_of_arms()
    model.prepare(torch.full((4,), 9.0), torch.full((4,), 9.0))
    (group,) = model.groups.children()
    assert group.mean.tolist() == [0] * 4


def test_without_a_scale_no_states_are_predicted():
    spec = GroupSpec("values", (0, 1))
    model = SceneDynamics(latent_channels=3, specs={"values": spec}, state_size=2, width=32)
    with pytest.raises(RecipeError, match="do not hold the scale of their states"):
        model.predict_states(
            torch.zeros(1, 1, 3, 8, 8), Conditioning(torch.zeros(1, 4, 32), None, None), 4
        )
