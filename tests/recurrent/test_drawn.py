"""A scene that is carried as its states: they are read, moved and drawn, each from the truth."""

import pytest
import torch
from torch.nn import functional

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.conditioner import Conditioning
from acwm_recurrent.drawn import DrawnStates
from acwm_recurrent.states import StateSight
from tests.recurrent.dots import world_of

FRAMES = 17


def arms(clips, seed):
    """Two joints of a planar arm that lag behind their targets, which the actions move; its hand.

    Standardised states `[B, T, 4]`: angles, and where the hand is, and actions `[B, T, 2]`.
    """
    random = torch.Generator().manual_seed(seed)
    actions = torch.rand(clips, FRAMES, 2, generator=random).mul(2).sub(1)
    target = angle = torch.rand(clips, 2, generator=random).mul(2).sub(1)
    passed = [angle]
    for action in actions[:, :-1].unbind(1):
        target = target + 0.3 * action
        angle = angle + 0.5 * (target - angle)
        passed.append(angle)
    angles = torch.stack(passed, 1)
    elbow = angles.cumsum(2)
    hand = torch.stack([elbow.cos().sum(2), elbow.sin().sum(2)], -1)
    return torch.cat([angles, hand], -1), actions


def model_of_arms(**parameters):
    asked = {"latent_channels": 3, "state_size": 4, "temporal_stride": 1}
    return DrawnStates(**asked | {"channels": 16, "width": 32, "blocks": 1} | parameters)


@pytest.mark.parametrize("following", [0, 2])
def test_it_learns_how_actions_move_states(following):
    """Two hundred steps foretell whole clips of a lag, and where that leads the hand."""
    model = model_of_arms(following=following)
    world = world_of(model, stride=1, states=4)
    optimizer = torch.optim.AdamW(world.parameters(), 3e-3)
    random = torch.Generator().manual_seed(0)
    states, actions = arms(512, seed=0)
    for step in range(200):
        rows = torch.randint(512, (128,), generator=random)
        optimizer.zero_grad()
        loss = world.motion_loss(actions[rows], states[rows], random, progress=step / 200)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(world.parameters(), 0.5)
        optimizer.step()
    states, actions = arms(64, seed=1)
    scene = model.start(torch.zeros(64, 1, 3, 8, 8))
    scene = scene._replace(states=states[:, 0], hidden=model.motion.begin(states[:, 0]))
    rows = world.conditioner.condition(world.normalise(actions), FRAMES, model.width)
    told = model.told_of(rows)
    for frame in range(1, FRAMES):
        scene, _ = model.step(scene, told[:, frame : frame + 1])
    moved = (states[:, -1] - states[:, 0]).abs().mean()
    assert (scene.states - states[:, -1]).abs().mean() < 0.25 * moved


def test_of_long_clips_a_step_moves_fewer(monkeypatch):
    """A step costs no more than it did, however long episodes are."""
    world = world_of(model_of_arms(), stride=1, states=4)
    states, actions = arms(8, seed=0)

    def loss(clips):
        random = torch.Generator().manual_seed(0)
        return world.motion_loss(actions[:clips], states[:clips], random, progress=1)

    monkeypatch.setattr("acwm_recurrent.drawn.START_NOISE", 0.0)
    few = loss(3)
    assert abs(loss(8) - few) > 1e-3
    monkeypatch.setattr("acwm_recurrent.drawn.MOVED_FRAMES", 3 * (FRAMES - 1))
    torch.testing.assert_close(loss(8), few)


def test_it_reads_what_a_picture_shows():
    """A dot in a channel of its own for each of two places; the states are where they are."""
    torch.manual_seed(0)
    sight = StateSight(2, 4, 16)
    optimizer = torch.optim.AdamW(sight.parameters(), 3e-3)
    sides = torch.linspace(-1, 1, 8)
    cells = torch.stack(torch.meshgrid(sides, sides, indexing="ij"), -1).flatten(0, 1)

    def pictures(clips, seed):
        random = torch.Generator().manual_seed(seed)
        places = torch.rand(clips, 2, 2, generator=random).mul(1.6).sub(0.8)
        apart = (places[:, :, None] - cells).square().sum(-1)
        return torch.exp(-10 * apart).unflatten(2, (8, 8)), places.flatten(1)

    for step in range(150):
        frames, places = pictures(64, step)
        optimizer.zero_grad()
        functional.mse_loss(sight(frames), places).backward()
        optimizer.step()
    frames, places = pictures(64, 1000)
    with torch.no_grad():
        assert (sight(frames) - places).abs().mean() < 0.06


def test_it_draws_what_it_is_told_and_learns_nothing_of_motion_by_it():
    torch.manual_seed(0)
    model = model_of_arms().eval()
    torch.nn.init.normal_(model.drawing.out.weight)
    states, _ = arms(2, seed=0)
    given, modulation = torch.randn(2, 1, 3, 8, 8), torch.randn(2, FRAMES, 32)
    conditioning = Conditioning(modulation, None, None)
    drawn = model(given, conditioning, FRAMES, states=states)
    drawn.square().mean().backward()
    idle = [*model.sight.parameters(), *model.motion.parameters()]
    assert all(each.grad is None for each in idle)
    other = states.clone()
    other[:, 9] += 1
    changed = (model(given, conditioning, FRAMES, states=other) - drawn).abs().amax((0, 2, 3, 4))
    assert changed.nonzero().flatten().tolist() == [8]  # frame 9 is the 9th after the given one


def test_it_learns_to_draw_states_as_wrong_as_it_reads_them():
    """All along as wrong as in the given frame; the hand is where these angles lead it."""
    torch.manual_seed(0)
    model = model_of_arms(following=2)
    states, _ = arms(8, seed=0)
    given = torch.randn(8, 1, 3, 8, 8)
    with torch.no_grad():
        course = model.train().true_course(given, states)[1]
        wrong = model.sight(given[:, 0])[:, :2] - states[:, 0, :2]
        angles, hands = course.split(2, -1)
        assert (angles - states[..., :2] - wrong[:, None]).abs().mean() < 0.03 < wrong.abs().mean()
        led, leads = model.motion.follow(angles), model.motion.follow(states[..., :2])
        assert (hands - states[..., 2:] - (led - leads)).abs().mean() < 0.03
        torch.testing.assert_close(model.eval().true_course(given, states)[1], states)


def test_what_does_not_fit_is_refused():
    with pytest.raises(RecipeError, match="at least 1"):
        model_of_arms(blocks=0)
    with pytest.raises(RecipeError, match=r"model\.following=4 of the 4 values"):
        model_of_arms(following=4)
    model = model_of_arms()
    with pytest.raises(ShapeError, match="DrawnStates takes latents"):
        model.start(torch.zeros(1, 1, 2, 8, 8))
    with pytest.raises(RecipeError, match=r"drawn_states takes actions .* conditioner=adaln"):
        model(torch.zeros(1, 1, 3, 8, 8), Conditioning(None, None, None), FRAMES)


def test_states_are_scaled_and_of_every_video_frame():
    """A model of raw states would have to know what a radian is beside a metre."""
    model = model_of_arms(temporal_stride=4)
    world = world_of(model, states=4)
    world.state_mean.copy_(torch.tensor([1.0, 2.0, 3.0, 4.0]))
    world.state_std.copy_(torch.tensor([2.0, 2.0, 4.0, 4.0]))
    states, _ = arms(2, seed=0)
    raw = states * world.state_std + world.state_mean
    torch.testing.assert_close(world._scaled(raw), states)
