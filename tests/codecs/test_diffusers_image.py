"""Any image autoencoder of diffusers, beside what diffusers itself computes."""

import json

import pytest
import torch

from acwm_core.checks import check_codec
from acwm_core.checks.trial import moving_discs
from acwm_core.errors import DataError, RecipeError
from acwm_core.plugins import catalog
from acwm_core.recipe import compose
from tests.checks.results import failures
from tests.extras import needs

pytestmark = needs("diffusers")

KINDS = ("autoencoder_kl", "autoencoder_tiny", "autoencoder_dc")


def tiny(name):
    """An autoencoder of diffusers with random weights: two halvings, four channels."""
    import diffusers

    torch.manual_seed(0)
    if name == "autoencoder_kl":
        made = diffusers.AutoencoderKL(
            down_block_types=("DownEncoderBlock2D",) * 3,
            up_block_types=("UpDecoderBlock2D",) * 3,
            block_out_channels=(8, 8, 8),
            norm_num_groups=4,
            latent_channels=4,
            scaling_factor=0.5,
        )
    elif name == "autoencoder_tiny":
        made = diffusers.AutoencoderTiny(
            encoder_block_out_channels=(8, 8, 8),
            decoder_block_out_channels=(8, 8, 8),
            num_encoder_blocks=(1, 1, 1),
            num_decoder_blocks=(1, 1, 1),
            latent_channels=4,
            scaling_factor=2.0,
            shift_factor=0.25,
        )
    else:
        made = diffusers.AutoencoderDC(
            latent_channels=4,
            attention_head_dim=4,
            encoder_block_out_channels=(8, 8, 8),
            decoder_block_out_channels=(8, 8, 8),
            encoder_layers_per_block=(1, 1, 1),
            decoder_layers_per_block=(1, 1, 1),
            encoder_qkv_multiscales=((), (), ()),
            decoder_qkv_multiscales=((), (), ()),
            scaling_factor=0.4,
        )
    return made.eval()


@pytest.fixture(scope="module", params=KINDS)
def saved(request, tmp_path_factory):
    """Name, autoencoder, and the folder that diffusers saved it in."""
    autoencoder = tiny(request.param)
    folder = tmp_path_factory.mktemp(request.param) / "model" / "vae"
    autoencoder.save_pretrained(folder)
    return request.param, autoencoder, str(folder.parent)


def make(name, **params):
    return catalog().create("codec", name, **params)


@torch.no_grad()
def raw_latents(autoencoder, frames):
    found = autoencoder.encode(frames * 2 - 1)
    if hasattr(found, "latent_dist"):
        return found.latent_dist.mode()
    return found.latents if hasattr(found, "latents") else found.latent


def spread(codec, video):
    channels = codec.encode(video).transpose(0, 2).flatten(1)
    return channels.mean(1), channels.std(1, correction=0)


@torch.no_grad()
def test_latents_and_pictures_are_those_of_diffusers(saved):
    name, autoencoder, weights = saved
    codec, video = make(name, weights=weights), moving_discs(2, 5, 32, 48, seed=1)
    latents = codec.encode(video)
    assert latents.shape == (2, 5, 4, 8, 12)
    config = autoencoder.config
    shift, scale = config.get("shift_factor") or 0.0, config["scaling_factor"]
    raw = raw_latents(autoencoder, video.flatten(0, 1))
    assert torch.allclose(latents.flatten(0, 1), (raw - shift) * scale, atol=1e-5)
    pictures = (autoencoder.decode(raw).sample / 2 + 0.5).clamp(0, 1)
    assert torch.allclose(codec.decode(latents).flatten(0, 1), pictures, atol=1e-5)


def test_measured_latents_have_zero_mean_and_unit_variance(saved):
    from acwm_codecs.diffusers_image import measured

    name, autoencoder, weights = saved
    videos = [moving_discs(1, 3, 32, 32, seed=seed) for seed in range(3)]
    found = measured(make(name, weights=weights), iter(videos))
    raw = raw_latents(autoencoder, torch.cat(videos).flatten(0, 1)).transpose(0, 1).flatten(1)
    assert found["latent_mean"] == pytest.approx(raw.mean(1).tolist(), abs=1e-5)
    codec = make(name, weights=weights, **found)
    mean, deviation = spread(codec, torch.cat(videos))
    assert mean.abs().max() < 1e-4
    assert (deviation - 1).abs().max() < 1e-3
    again = measured(codec, videos)
    assert again["latent_std"] == pytest.approx(found["latent_std"], rel=1e-4)
    assert codec.fingerprint() != make(name, weights=weights).fingerprint()


def test_it_conforms(saved):
    from acwm_codecs.diffusers_image import measured

    name, _, weights = saved
    found = measured(make(name, weights=weights), [moving_discs(1, 5, 64, 64, seed=2)])
    assert failures(check_codec(name, weights=weights, **found)) == {}


@torch.no_grad()
def test_a_configuration_with_statistics_per_channel_is_followed(tmp_path):
    autoencoder = tiny("autoencoder_kl")
    mean, deviation = [0.1, -0.2, 0.3, 0.0], [0.5, 1.0, 2.0, 4.0]
    autoencoder.register_to_config(latents_mean=mean, latents_std=deviation)
    autoencoder.save_pretrained(tmp_path)
    codec, frame = make("autoencoder_kl", weights=str(tmp_path)), moving_discs(1, 1, 32, 32)
    raw = raw_latents(autoencoder, frame[0])[0]
    columns = [torch.tensor(values).view(-1, 1, 1) for values in (mean, deviation)]
    wanted = (raw - columns[0]) * 0.5 / columns[1]
    assert torch.allclose(codec.encode(frame)[0, 0], wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("params", "message"),
    [
        ({"latent_mean": (0.0,)}, "codec.latent_mean=.*: give 4 finite numbers"),
        ({"latent_std": (1.0, 1.0, 1.0, float("nan"))}, "codec.latent_std=.*: give 4 finite"),
        ({"latent_std": (1.0, 1.0, 0.0, 1.0)}, "give positive numbers"),
    ],
)
def test_numbers_that_cannot_be_are_refused(saved, params, message):
    name, _, weights = saved
    with pytest.raises(DataError, match=message):
        make(name, weights=weights, **params)


def test_weights_of_another_kind_and_none_are_refused(saved, tmp_path):
    name, _, weights = saved
    other = next(kind for kind in KINDS if kind != name)
    with pytest.raises(DataError, match=f"codec '{other}': .* is of an Autoencoder"):
        make(other, weights=weights)
    with pytest.raises(RecipeError, match=r"needs the parameter 'weights'; add codec.weights="):
        compose("push_cube_small", [f"codec={name}"])
    (tmp_path / "config.json").write_text(json.dumps({"_class_name": "Nonsuch"}))
    with pytest.raises(DataError, match=f"codec '{name}'"):
        make(name, weights=str(tmp_path))
