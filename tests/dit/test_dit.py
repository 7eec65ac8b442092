"""Properties of the DiT that hold whatever its weights."""

import pytest
import torch

from acwm_core.errors import RecipeError, ShapeError
from acwm_dit.adaln import AdaLN
from acwm_dit.attention import attend, spatial_rotation, temporal_rotation
from acwm_dit.dit import DiT

FIT = {"width": 32, "layers": 2, "heads": 2}


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def scrambled(module):
    """The module with random weights everywhere, so that nothing is zero or the identity."""
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter, std=0.2)
    return module


def model(**params):
    return scrambled(DiT(latent_channels=4, **FIT, **params))


def inputs(frames=4, height=4, width=6, batch=2):
    conditioner = scrambled(AdaLN(action_size=3, temporal_stride=4, **FIT))
    latents = torch.randn(batch, frames, 4, height, width)
    sigma = torch.rand(batch, frames)
    return latents, sigma, conditioner(torch.randn(batch, 1 + 4 * (frames - 1), 3))


def test_patch_size_one_takes_odd_sides():
    latents, sigma, conditioning = inputs(2, 3, 5)
    assert model(patch_size=1)(latents, sigma, conditioning).shape == latents.shape


def test_a_fresh_model_returns_zeros():
    fresh = DiT(latent_channels=4, **FIT)
    assert not fresh(*inputs()).any()


@pytest.mark.parametrize("causal", [False, True])
def test_causality_in_time(causal):
    latents, sigma, conditioning = inputs(frames=4)
    network = model(causal=causal)
    before = network(latents, sigma, conditioning)
    latents = latents.clone()
    latents[:, 2] += 1
    changed = (network(latents, sigma, conditioning) - before).abs().amax((0, 2, 3, 4)) > 1e-5
    assert changed.tolist() == ([False, False, True, True] if causal else [True] * 4)


def test_position_matters_in_space():
    latents, sigma, conditioning = inputs()
    network = model()
    mirrored = network(latents.roll(2, -1), sigma, conditioning).roll(-2, -1)
    assert not torch.allclose(mirrored, network(latents, sigma, conditioning), atol=1e-4)


def test_rotation_makes_attention_depend_on_the_distance_alone():
    turn = temporal_rotation(9, 8, torch.device("cpu"))
    query, key = torch.randn(2, 8).double()
    queries, keys = turn(query.expand(9, 8)), turn(key.expand(9, 8))
    scores = queries @ keys.T
    for distance in range(-8, 9):
        diagonal = scores.diagonal(distance)
        torch.testing.assert_close(diagonal, diagonal[:1].expand_as(diagonal))
    assert scores[0].std() > 1e-3


def test_spatial_rotation_turns_half_with_rows_and_half_with_columns():
    turn = spatial_rotation(3, 5, 8, torch.device("cpu"))
    sine = turn.sine.unflatten(0, (3, 5))[..., 4:]
    assert (sine[..., :2] == sine[:, :1, :2]).all()
    assert (sine[..., 2:] == sine[:1, :, 2:]).all()
    torch.testing.assert_close(sine[1, 0], torch.tensor([1.0, 0.01, 0.0, 0.0]).sin())


@pytest.mark.parametrize("causal", [False, True])
def test_bfloat16_attention_on_a_cpu_agrees_with_float32(causal):
    q, k, v = torch.randn(3, 2, 3, 10, 16)
    exact = torch.nn.functional.scaled_dot_product_attention(q, k, v, is_causal=causal)
    rough = attend(*(x.bfloat16() for x in (q, k, v)), causal=causal)
    assert rough.dtype == torch.bfloat16
    torch.testing.assert_close(rough.float(), exact, rtol=0.03, atol=0.03)


def test_autocast_stays_near_float32_and_returns_float32():
    latents, sigma, conditioning = inputs()
    network = model()
    exact = network(latents, sigma, conditioning)
    with torch.autocast("cpu", torch.bfloat16):
        rough = network(latents, sigma, conditioning)
    assert rough.dtype == torch.float32
    assert (rough - exact).norm() < 0.05 * exact.norm()


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((2, 4, 5, 4, 4), r"\[B, L, 4, h, w\]"),
        ((2, 4, 4, 4), r"\[B, L, 4, h, w\]"),
        ((2, 4, 4, 3, 4), "patches of 2"),
    ],
)
def test_wrong_latents_are_refused(shape, message):
    _, sigma, conditioning = inputs()
    with pytest.raises(ShapeError, match=message):
        model()(torch.zeros(shape), sigma, conditioning)


def test_wrong_sigma_is_refused():
    latents, _, conditioning = inputs()
    with pytest.raises(ShapeError, match="sigma"):
        model()(latents, torch.zeros(2), conditioning)


@pytest.mark.parametrize(("width", "heads"), [(32, 3), (36, 6)])
def test_heads_that_do_not_divide_the_width_are_refused(width, heads):
    with pytest.raises(RecipeError, match="multiple of 4"):
        DiT(latent_channels=4, width=width, heads=heads)


@pytest.mark.parametrize("name", ["width", "layers", "heads", "patch_size"])
def test_sizes_below_one_are_refused(name):
    with pytest.raises(RecipeError, match="at least 1"):
        DiT(latent_channels=4, **{name: 0})
