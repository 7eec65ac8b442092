"""Every codec decodes a stream to the video that decoding all of its latents gives."""

import pytest
import torch

from acwm_core.checks.trial import shaken
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from tests.codecs.tiny_autoencoders import save_tiny_codecs

FIT = {"width": 16, "layers": 1, "heads": 2}


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    pytest.importorskip("diffusers")
    return save_tiny_codecs(tmp_path_factory.mktemp("weights"))


def codec_of(name, request):
    if name in ("compact", "fine", "identity"):
        return catalog().create("codec", name)
    return catalog().create("codec", name, weights=request.getfixturevalue("weights")[name])


@pytest.mark.parametrize("name", ["compact", "fine", "identity", "wan", "wan_per_frame", "flux"])
def test_a_stream_shows_what_its_latents_decode_to(name, request):
    codec = codec_of(name, request)
    model = catalog().create("model", "dit_xs", latent_channels=codec.channels, causal=True, **FIT)
    stride = codec.temporal_stride
    conditioner = catalog().create(
        "conditioner", "adaln", action_size=2, temporal_stride=stride, **FIT
    )
    objective = DiffusionForcing(prediction="clean", steps=1)
    parts = codec, shaken(model), conditioner, objective
    world = WorldModel(*parts, [-1.0, -1.0], [1.0, 1.0]).eval()
    first = torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(0))
    stream = world.stream(first, context=3)
    frames, latents = [stream.first[:, None]], [stream._latents.last]
    for _ in range(4):
        frames.append(stream.step(torch.zeros(2, stride, 2)))
        latents.append(stream._latents.last)
    with torch.no_grad():
        whole = codec.decode(torch.cat(latents, 1))
    assert whole.shape[1] == 1 + 4 * stride
    assert whole.std() > 0.01
    torch.testing.assert_close(torch.cat(frames, 1), whole, rtol=0, atol=1e-5)
