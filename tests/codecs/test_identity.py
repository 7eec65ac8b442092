"""The identity codec loses nothing and keeps the promises of every codec."""

import pytest
import torch

from acwm_codecs.identity import Identity
from acwm_core.errors import RecipeError, ShapeError


def eight_bit(*shape):
    pixels = torch.randint(0, 256, shape, generator=torch.Generator().manual_seed(0))
    return pixels.float() / 255


@pytest.mark.parametrize("strides", [(8, 4), (1, 1), (4, 3), (2, 1)])
@pytest.mark.parametrize("frames", [1, 6, 13])
def test_round_trip_is_exact(strides, frames):
    codec = Identity(spatial_stride=strides[0], temporal_stride=strides[1])
    video = eight_bit(2, frames, 3, 16, 24)
    back = codec(video)
    torch.testing.assert_close(back, video, rtol=0, atol=1e-7)
    assert torch.equal((back * 255).round(), (video * 255).round())


def test_a_latent_pixel_holds_its_own_block():
    codec = Identity(spatial_stride=2, temporal_stride=2)
    video = torch.full((1, 3, 3, 4, 4), 0.5)
    video[0, 2, :, 2:, :2] = 1  # the second frame of the second group, lower left block
    changed = codec.encode(video).abs().sum(2)[0]
    assert changed.nonzero().tolist() == [[1, 1, 0]]
    assert changed[1, 1, 0] == 2 * 12


def test_fingerprint_tells_strides_apart():
    assert Identity().fingerprint() == Identity().fingerprint()
    assert Identity().fingerprint() != Identity(temporal_stride=2).fingerprint()
    assert Identity(spatial_stride=1).fingerprint() != Identity().fingerprint()


def test_bad_input_is_refused():
    with pytest.raises(RecipeError, match="temporal_stride=0"):
        Identity(temporal_stride=0)
    with pytest.raises(ShapeError, match="multiples of 8"):
        Identity().encode(torch.zeros(1, 1, 3, 12, 8))
    with pytest.raises(ShapeError, match="768"):
        Identity().decode(torch.zeros(1, 1, 16, 2, 2))
