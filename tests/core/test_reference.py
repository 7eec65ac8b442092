"""A codec that decodes with a reference sees the last given frame, wherever a model predicts."""

import copy

import pytest
import torch

from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.world_model import WorldModel
from tests.core.test_streaming import CausalModel, FrameCodec, RecentConditioner


class Echo(FrameCodec):
    """Decodes everything to its reference."""

    frame = None

    def with_reference(self, frame):
        seeing = copy.copy(self)
        seeing.frame = frame
        return seeing

    def _decode(self, latents):
        return self.frame[:, None].expand(-1, self.video_frames(latents.shape[1]), -1, -1, -1)


@pytest.fixture
def world():
    torch.manual_seed(0)
    codec = Echo()
    model = CausalModel(latent_channels=codec.channels)
    conditioner = RecentConditioner(action_size=2, width=model.width)
    objective = DiffusionForcing(prediction="clean", steps=1)
    parts = codec, model, conditioner, objective
    return WorldModel(*parts, [-1.0, -1.0], [1.0, 1.0], clip_frames=13, context_frames=5)


@pytest.mark.parametrize("mode", ["windows", "stream", "whole"])
def test_a_rollout_is_decoded_with_the_last_given_frame(world, mode):
    """In all of its windows: what they begin with is no longer a true frame."""
    given = torch.rand(2, 5, 3, 16, 16)
    video = world.rollout(given, torch.zeros(2, 30, 2), mode=mode)
    assert torch.equal(video, given[:, -1:].expand_as(video))


def test_a_stream_is_decoded_with_the_last_given_frame(world):
    given = torch.rand(1, 5, 3, 16, 16)
    frames = world.stream(given, torch.zeros(1, 4, 2)).step(torch.zeros(1, 4, 2))
    assert torch.equal(frames, given[:, -1:].expand_as(frames))


def test_a_reconstruction_is_decoded_with_the_first_frame(world):
    video = torch.rand(2, 9, 3, 16, 16)
    assert torch.equal(world.codec(video), video[:, :1].expand_as(video))


def test_predicted_latents_are_those_of_a_rollout_in_one_window(world, monkeypatch):
    given, actions = torch.rand(2, 5, 3, 16, 16), torch.rand(2, 11, 2)
    latents = world.predict_latents(given, actions, seeds=[3, 4])
    monkeypatch.setattr(world, "codec", FrameCodec())
    expected = world.rollout(given, actions, mode="whole", seeds=[3, 4])
    torch.testing.assert_close(world.codec.decode(latents, 11), expected)
