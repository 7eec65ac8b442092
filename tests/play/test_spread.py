"""How far samples are apart: a figure of models that draw noise."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from acwm_core.checks.trial import shaken
from acwm_core.data.pictures import to_pixels
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.objectives.regression import Regression
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_play import live_model
from acwm_play.live_model import LiveModel
from tests.play import follower

FIT = {"width": 16, "layers": 1, "heads": 2}

CARD = SimpleNamespace(
    name="plane",
    frame_size=(32, 48),
    fps=10,
    action=SimpleNamespace(size=2, low=(-1.0, -1.0), high=(1.0, 1.0)),
)


def world_of(model, codec):
    follows = isinstance(model, follower.Follower)
    objective = Regression() if follows else DiffusionForcing(prediction="clean", steps=1)
    about = {"width": model.width, "layers": model.layers, "heads": model.heads}
    kind = "raw" if follows else "adaln"
    conditioner = catalog().create(
        "conditioner", kind, action_size=2, temporal_stride=codec.temporal_stride, **about
    )
    parts = codec, shaken(model), conditioner, objective
    return WorldModel(*parts, [-1.0] * 2, [1.0] * 2).eval()


@pytest.fixture
def world():
    codec = catalog().create("codec", "identity")
    model = catalog().create("model", "dit_xs", latent_channels=codec.channels, causal=True, **FIT)
    return world_of(model, codec)


@pytest.fixture
def frame():
    return np.random.default_rng(0).integers(0, 256, (1, *CARD.frame_size, 3), np.uint8)


ACTIONS = [np.full(2, 0.5, np.float32)] * 4


def test_the_spread_is_that_of_single_streams(world, frame, monkeypatch):
    monkeypatch.setattr(live_model, "SHARE", float("inf"))
    played = LiveModel(world, CARD, None)
    played.restart(frame, [])
    assert played.spread is None
    given = torch.from_numpy(frame).permute(0, 3, 1, 2)[None] / 255
    streams = [world.stream(given, seeds=[seed]) for seed in range(live_model.SAMPLES)]
    for _ in range(2):
        shown = played.step(ACTIONS)
        alone = [s.step(torch.from_numpy(np.stack(ACTIONS)[None]))[0] for s in streams]
        np.testing.assert_array_equal(shown, to_pixels(alone[0]))
        last = np.stack([each[-1].numpy() for each in alone])
        expected = np.sqrt(np.mean(last.std(0, ddof=1) ** 2))
        assert played.spread == pytest.approx(expected, rel=1e-3)
        assert played.spread > 0.01
        std = last.std(0, ddof=1).max(0)  # the largest over channels
        assert played.doubt[0, ..., 0] == pytest.approx(255 * std, abs=1)
        assert (played.doubt == played.doubt[..., :1]).all()


def test_another_draw_is_another_future_and_the_first_comes_back(world, frame):
    played, futures = LiveModel(world, CARD, None), []
    for played.draw in (0, 1, 0):
        played.restart(frame, [])
        futures.append(played.step(ACTIONS))
    assert played.samples
    assert not np.array_equal(futures[0], futures[1])
    assert np.array_equal(futures[0], futures[2])


def test_samples_end_where_they_take_too_long(world, frame, monkeypatch):
    monkeypatch.setattr(live_model, "SHARE", -1.0)
    played = LiveModel(world, CARD, None)
    played.restart(frame, [])
    played.step(ACTIONS)
    assert played.spread is not None
    played.step(ACTIONS)
    assert played.spread is None
    played.restart(frame, [])
    played.step(ACTIONS)
    assert played.spread is not None


def test_a_model_without_noise_has_none(frame):
    follower.register()
    codec = catalog().create("codec", "identity")
    card = SimpleNamespace(**{**vars(CARD), "frame_size": (64, 64)})
    world = world_of(follower.Follower(latent_channels=codec.channels), codec)
    played = LiveModel(world, card, None)
    assert not played.samples
    played.restart(np.zeros((1, 64, 64, 3), np.uint8), [])
    played.step(ACTIONS)
    assert played.spread is None
