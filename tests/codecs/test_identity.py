"""The identity codec loses nothing and keeps the promises of every codec."""

import pytest
import torch

from acwm_codecs.identity import Identity
from acwm_core.errors import RecipeError, ShapeError


def eight_bit(*shape):
    pixels = torch.randint(0, 256, shape, generator=torch.Generator().manual_seed(0))
    return pixels.float() / 255


@pytest.mark.parametrize("strides", [(8, 4), (1, 1), (4, 3), (2, 1)])
@pytest.mark.parametrize("frames", [1, 13])
def test_round_trip_is_exact(strides, frames):
    codec = Identity(spatial_stride=strides[0], temporal_stride=strides[1])
    video = eight_bit(2, frames, 3, 16, 24)
    back = codec(video)
    torch.testing.assert_close(back, video, rtol=0, atol=1e-7)
    assert torch.equal((back * 255).round(), (video * 255).round())


def test_lengths_that_do_not_fill_a_group_lose_no_frame():
    video = eight_bit(1, 6, 3, 8, 8)
    assert torch.equal((Identity()(video) * 255).round(), (video * 255).round())


def test_shape_matches_what_the_codec_declares():
    codec = Identity()
    latents = codec.encode(eight_bit(2, 37, 3, 64, 48))
    assert codec.channels == 768
    assert latents.shape == (2, codec.latent_frames(37), 768, *codec.latent_size(64, 48))


def test_latents_are_near_zero_mean_and_unit_variance():
    latents = Identity().encode(eight_bit(1, 5, 3, 64, 64))
    assert latents.mean().abs() < 0.05
    assert 0.5 < latents.std() < 2


def test_encoding_of_a_prefix_is_the_prefix_of_the_encoding():
    video, codec = eight_bit(1, 9, 3, 8, 8), Identity()
    assert torch.equal(codec.encode(video[:, :5]), codec.encode(video)[:, :2])


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
