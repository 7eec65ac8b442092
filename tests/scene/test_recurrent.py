"""The recurrent model: what it computes, that it learns motion; other models without noise."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from acwm_core.checks.trial import WIDTH, TinyPredictor
from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.batch import Batch
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.dynamics import Predictor
from acwm_core.model.objectives.regression import Regression
from acwm_core.model.world_model import DECODED_TOGETHER
from acwm_core.training.config import TrainingConfig
from acwm_core.training.optimizers import build_optimizer
from acwm_scene.layers import MatrixConv
from acwm_scene.recurrent import RecurrentModel
from tests.scene.dots import moving_dots, world_codec, world_of


@pytest.fixture
def world():
    torch.manual_seed(0)
    made = world_of(RecurrentModel(latent_channels=world_codec().channels, channels=8, width=16))
    for parameter in made.model.parameters():
        nn.init.normal_(parameter, std=0.2)
    return made.eval()


def frames_and_actions(frames, batch=2):
    generator = torch.Generator().manual_seed(1)
    first = torch.rand(batch, 3, 16, 24, generator=generator)
    return first, torch.rand(batch, frames, 2, generator=generator) * 2 - 1


def test_a_matrix_convolution_is_a_convolution():
    torch.manual_seed(0)
    ours, usual = MatrixConv(3, 5), nn.Conv2d(3, 5, 3, padding=1)
    with torch.no_grad():
        usual.weight.copy_(ours.weight.reshape(5, 3, 3, 3).permute(0, 3, 1, 2))
        usual.bias.copy_(ours.bias)
    grid = torch.randn(2, 3, 6, 7)
    torch.testing.assert_close(ours(grid), usual(grid))


def test_a_stream_gives_the_frames_of_the_whole_clip(world):
    first, actions = frames_and_actions(17)
    whole = world.rollout(first, actions, window=17)
    stream = world.stream(first)
    streamed = torch.cat([stream.first[:, None], *stream.play(actions[:, :-1])], 1)
    torch.testing.assert_close(streamed, whole)


@pytest.mark.parametrize("known", [1, 5])
def test_it_carries_its_state_through_the_whole_episode_by_default(world, known):
    """The frames of one long prediction, whatever the length of a clip, in parts of 32 frames."""
    given = torch.rand(2, known, 3, 16, 24, generator=torch.Generator().manual_seed(3))
    _, actions = frames_and_actions(95)
    assert world.mode == "stream"
    rolled = world.rollout(given, actions)
    torch.testing.assert_close(rolled, world.rollout(given, actions, mode="whole"))
    assert not torch.allclose(rolled, world.rollout(given, actions, mode="windows"), atol=1e-3)
    parts = [part.shape[1] for part in world.rollout_chunks(given, actions)]
    assert parts[0] == known
    assert sum(parts) == 95
    assert max(parts[1:]) == 4 * DECODED_TOGETHER


def test_given_frames_and_the_actions_between_them_reach_its_stream(world):
    given = torch.rand(2, 5, 3, 16, 24, generator=torch.Generator().manual_seed(3))
    _, actions = frames_and_actions(13)
    stream = world.stream(given, actions[:, :4])
    torch.testing.assert_close(stream.given, world.codec(given))
    streamed = torch.cat([stream.given, *stream.play(actions[:, 4:-1])], 1)
    torch.testing.assert_close(streamed, world.rollout(given, actions, mode="whole"))
    with pytest.raises(ShapeError, match=r"between 5 frames there are actions \[2, 4, .A.\]"):
        world.stream(given, actions[:, :3])


def test_nothing_is_random(world):
    first, actions = frames_and_actions(9)
    one, other = (world.rollout(first, actions, seeds=[seed, 5]) for seed in (1, 2))
    torch.testing.assert_close(one, other)


def test_frames_asked_for_alone_are_those_of_the_whole_clip(world, monkeypatch):
    """Which saves reading the others."""
    given = torch.randn(2, 2, world_codec().channels, 8, 8)
    modulation = torch.randn(2, 7, world.model.width)
    clip = Batch(given, Conditioning(modulation, None, None), [torch.Generator()] * 2)
    read, read_all = [], world.model._read
    monkeypatch.setattr(world.model, "_read", lambda *a: read.append(len(a[0])) or read_all(*a))
    with torch.no_grad():
        whole = world.objective.predict(world.model, clip, 7)
        some = world.objective.predict_frames(world.model, clip, 7, [6, 3])
    torch.testing.assert_close(some, whole[:, [6, 3]])
    assert read == [2 * 5, 2 * 2]


def test_a_fresh_model_repeats_the_given_frame():
    model = RecurrentModel(latent_channels=4)
    given = torch.randn(2, 1, 4, 8, 8)
    predicted = model(given, Conditioning(torch.zeros(2, 5, 192), None, None), 5)
    torch.testing.assert_close(predicted, given.expand(-1, 4, -1, -1, -1))


def drifting(batch, seed):
    """Latents `[B, 6, 1, 4, 4]`, each changing at a speed of its own that no action tells."""
    generator = torch.Generator().manual_seed(seed)
    start, speed = torch.randn(2, batch, 1, 1, 1, 1, generator=generator)
    latents = (start + speed * torch.arange(6.0)[:, None, None, None]).expand(-1, -1, 1, 4, 4)
    return Batch(latents, Conditioning(torch.zeros(batch, 6, 16), None, None), [])


@pytest.mark.ci
def test_several_given_frames_show_velocities():
    """One frame leaves all of what follows unknown: its least error is E[(speed · n)²] = 11."""
    errors = {}
    for known in (1, 2):
        torch.manual_seed(0)
        model = RecurrentModel(latent_channels=1, channels=8, width=16, blocks=1)
        optimizer = torch.optim.AdamW(model.parameters(), 1e-2)
        for step in range(120):
            optimizer.zero_grad()
            Regression().loss(model, drifting(16, step), known).backward()
            optimizer.step()
        with torch.no_grad():
            errors[known] = Regression().loss(model, drifting(256, 10_000), known).item()
    assert errors[1] > 8
    assert errors[2] < 1


def test_wrong_sizes_are_refused():
    with pytest.raises(RecipeError, match="at least 1"):
        RecurrentModel(latent_channels=4, channels=0)
    model = RecurrentModel(latent_channels=4)
    bare = Conditioning(torch.zeros(1, 2, 192), None, None)
    with pytest.raises(ShapeError, match=r"latents \[B, L, 4, h, w\]"):
        model(torch.zeros(1, 1, 3, 8, 8), bare, 2)
    with pytest.raises(RecipeError, match="set conditioner=adaln"):
        model(torch.zeros(1, 1, 4, 8, 8), Conditioning(None, None, None), 2)


@pytest.mark.ci
def test_it_learns_to_move_what_actions_move():
    """Better than standing still, and only under the true actions."""
    torch.manual_seed(0)
    model = RecurrentModel(latent_channels=2, channels=16, width=32, blocks=1)
    world = world_of(model, stride=1)
    config = TrainingConfig(optimizer="muon", learning_rate=1e-2)
    optimizer = build_optimizer(world, config, fused=False)
    for step in range(100):
        latents, moves = moving_dots(24, step)
        loss = world.loss(latents, moves, [])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    latents, moves = moving_dots(64, 10_000)
    with torch.no_grad():
        error = world.loss(latents, moves, []).item()
        shuffled = world.loss(latents, moves.roll(1, 0), []).item()
    still = (latents[:, 1:] - latents[:, :1]).square().mean().item()
    assert error < 0.5 * still
    assert error < 0.5 * shuffled


def test_frames_that_are_drawn_have_the_loss_of_all_on_average():
    torch.manual_seed(0)
    model = RecurrentModel(latent_channels=2, blocks=1, channels=8, width=16)
    for parameter in model.parameters():
        nn.init.normal_(parameter, std=0.2)
    latents, modulation = torch.randn(4, 6, 2, 8, 8), torch.randn(4, 6, 16)

    def loss(frames, seed):
        generators = [torch.Generator().manual_seed(4 * seed + clip) for clip in range(4)]
        batch = Batch(latents, Conditioning(modulation, None, None), generators)
        with torch.no_grad():
            return Regression(frames=frames).loss(model, batch, 1).item()

    drawn = [loss(2, seed) for seed in range(200)]
    assert np.mean(drawn) == pytest.approx(loss(None, 0), rel=0.02)
    assert len({*drawn}) > 100
    assert loss(2, 7) == drawn[7]
    assert loss(9, 0) == pytest.approx(loss(None, 0), rel=1e-5)
    model.eval()
    assert loss(2, 0) == loss(None, 0)


def test_a_model_that_returns_all_frames_has_those_asked_for_cut_out():
    latents, modulation = torch.randn(2, 3, 2, 8, 8), torch.randn(2, 3, WIDTH)
    batch = Batch(latents, Conditioning(modulation, None, None), [torch.Generator()] * 2)
    model = TinyPredictor(2)
    whole = Regression().predict(model, replace(batch, latents=latents[:, :1]), 3)
    some = Regression().predict_frames(model, replace(batch, latents=latents[:, :1]), 3, [2])
    torch.testing.assert_close(some, whole[:, 2:])
    with pytest.raises(RecipeError, match="at least 1"):
        Regression(frames=0)


def test_muon_gets_the_convolutions_and_no_other_parameter_is_left_out(world):
    config = TrainingConfig(optimizer="muon")
    optimizer = build_optimizer(world, config, fused=False)
    updated = [id(p) for group in optimizer.param_groups for p in group["params"]]
    trained = [p for p in world.parameters() if p.requires_grad]
    assert sorted(updated) == sorted(map(id, trained))
    matrices = {id(p) for p in optimizer.param_groups[0]["params"]}
    convolutions = [m for m in world.model.modules() if isinstance(m, MatrixConv)]
    assert matrices == {id(c.weight) for c in convolutions}


class Copier(Predictor):
    """A third party's model without a single matrix: the last frame, plus a bias per action."""

    width, layers, heads, causal = 4, 0, 1, True

    def __init__(self, *, latent_channels):
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(latent_channels))

    def forward(self, given, conditioning, frames, generators=()):
        push = conditioning.modulation[:, 1:frames].mean(-1).cumsum(1)[..., None, None, None]
        clip = given[:, -1:] + push * (1 + self.bias[:, None, None])
        return clip[:, given.shape[1] - 1 :]


def test_a_model_of_a_third_party_needs_neither_noise_nor_matrices():
    world = world_of(Copier(latent_channels=world_codec().channels))
    with pytest.warns(UserWarning, match="AdamW updates all of it"):
        optimizer = build_optimizer(world, TrainingConfig(optimizer="muon"), fused=False)
    before = copy.deepcopy(world.state_dict())
    first, actions = frames_and_actions(9)
    latents = world.encode(torch.rand(2, 9, 3, 16, 24))
    world.loss(latents, actions, []).backward()
    optimizer.step()
    assert not torch.equal(before["model.bias"], world.model.bias)
    assert world.mode == "windows"
    assert world.rollout(first, actions).shape == (2, 9, 3, 16, 24)
    with pytest.raises(RecipeError, match="cannot be streamed"):
        world.stream(first)


def test_gradients_have_the_strides_of_their_weights():
    """Otherwise DDP warns and copies; with bfloat16, a 1×1 kernel's are those of channels last."""
    model = RecurrentModel(latent_channels=16, channels=64, width=16, blocks=1)
    conditioning = Conditioning(torch.randn(2, 4, 16), None, model)
    with torch.autocast("cpu", torch.bfloat16):
        model(torch.randn(2, 1, 16, 8, 8), conditioning, 4).sum().backward()
    assert all(each.grad.stride() == each.stride() for each in model.parameters())
