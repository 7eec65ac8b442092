"""The codecs with published weights, on tiny weights in every file format they come in."""

import json
import pickle
import shutil
import sys

import pytest
import torch
from click.testing import CliRunner
from safetensors.torch import load_file, save_file

from acwm_core.checks.codec import CodecChecks
from acwm_core.checks.result import checks_of
from acwm_core.checks.trial import moving_discs
from acwm_core.cli import main
from acwm_core.errors import DataError, MissingExtraError, ShapeError
from acwm_core.model.build import build_world_model
from acwm_core.plugins import catalog
from acwm_core.recipe import compose
from tests.codecs.tiny_autoencoders import original_state, save_tiny_codecs, tiny_flux, tiny_wan
from tests.extras import needs

pytestmark = needs("diffusers")

NAMES = ("wan", "wan_per_frame", "flux")
TENSORS = "diffusion_pytorch_model.safetensors"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return save_tiny_codecs(tmp_path_factory.mktemp("tiny"))


def make(name, weights):
    return catalog().create("codec", name, weights=str(weights))


def clip(frames, batch=1):
    return moving_discs(batch, frames, 32, 48, 1)


@pytest.mark.parametrize("name", NAMES)
def test_strides_channels_and_frozen_weights(folders, name):
    codec = make(name, folders[name])
    assert (codec.channels, codec.spatial_stride) == (16, 8)
    assert codec.temporal_stride == (4 if name == "wan" else 1)
    assert not codec.training
    assert not any(parameter.requires_grad for parameter in codec.parameters())


@torch.no_grad()
def test_wan_latents_are_the_autoencoders_normalised(folders):
    autoencoder, video = tiny_wan(), clip(9)
    raw = autoencoder.encode(video.transpose(1, 2) * 2 - 1).latent_dist.mean
    mean, deviation = (
        torch.tensor(autoencoder.config[key]).view(1, -1, 1, 1, 1)
        for key in ("latents_mean", "latents_std")
    )
    codec = make("wan", folders["wan"])
    latents = codec.encode(video)
    torch.testing.assert_close(latents, ((raw - mean) / deviation).transpose(1, 2))
    decoded = autoencoder.decode(raw).sample.transpose(1, 2)
    torch.testing.assert_close(codec.decode(latents), ((decoded + 1) / 2).clamp(0, 1))


@torch.no_grad()
def test_wan_per_frame_is_wan_on_clips_of_one_frame(folders):
    video = clip(3)
    wan, per_frame = make("wan", folders["wan"]), make("wan_per_frame", folders["wan"])
    alone = torch.cat([wan.encode(video[:, i : i + 1]) for i in range(3)], 1)
    torch.testing.assert_close(per_frame.encode(video), alone)
    decoded = torch.cat([wan.decode(alone[:, i : i + 1]) for i in range(3)], 1)
    torch.testing.assert_close(per_frame.decode(alone), decoded)


@torch.no_grad()
def test_flux_latents_are_the_autoencoders_shifted_and_scaled(folders):
    autoencoder, video = tiny_flux(), clip(6, batch=2)
    raw = autoencoder.encode(video.flatten(0, 1) * 2 - 1).latent_dist.mean
    shift, scale = autoencoder.config.shift_factor, autoencoder.config.scaling_factor
    codec = make("flux", folders["flux"])
    latents = codec.encode(video)
    torch.testing.assert_close(latents, ((raw - shift) * scale).unflatten(0, (2, 6)))
    decoded = autoencoder.decode(raw).sample.unflatten(0, (2, 6))
    torch.testing.assert_close(codec.decode(latents), ((decoded + 1) / 2).clamp(0, 1))


@torch.no_grad()
def test_wan_keeps_the_frames_that_diffusers_drops(folders):
    video, autoencoder = clip(12), tiny_wan()
    theirs = autoencoder(video.transpose(1, 2) * 2 - 1).sample
    assert theirs.shape[2] == 9
    assert make("wan", folders["wan"])(video).shape == video.shape


@torch.no_grad()
@pytest.mark.parametrize("name", NAMES)
def test_latent_frames_that_come_one_by_one_decode_alike(folders, name):
    codec = make(name, folders[name])
    latents = codec.encode(clip(17, batch=2))
    whole = codec.decode(latents)
    first, other = codec.frame_decoder(), codec.frame_decoder()
    streamed = []
    for latent in latents.split(1, 1):
        streamed.append(first(latent))
        other(torch.randn_like(latent))  # a second stream beside it
    torch.testing.assert_close(torch.cat(streamed, 1), whole, rtol=0, atol=1e-5)
    several = codec.frame_decoder()
    parts = [several(part) for part in latents.split([1, 2, latents.shape[1] - 3], 1)]
    torch.testing.assert_close(torch.cat(parts, 1), whole, rtol=0, atol=1e-5)
    with pytest.raises(ShapeError, match="decodes"):
        several(latents[0])


@torch.no_grad()
@pytest.mark.parametrize("name", NAMES)
def test_a_long_clip_passes_a_few_frames_at_a_time(folders, name):
    codec, seen = make(name, folders[name]), []
    for half in (codec.autoencoder.encoder, codec.autoencoder.decoder):
        half.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].shape))
    assert codec(clip(40)[..., :16, :16]).shape[1] == 40
    frames = [shape[2] if name != "flux" else shape[0] for shape in seen]
    assert max(frames) == (1 if name == "wan_per_frame" else 4)


@torch.no_grad()
@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_the_original_release_gives_the_same_codec(tmp_path, suffix):
    path = tmp_path / f"Wan2.1_VAE{suffix}"
    from diffusers import AutoencoderKLWan

    torch.manual_seed(1)
    autoencoder = AutoencoderKLWan(base_dim=4)  # its statistics are those of the release
    state = original_state(autoencoder)
    if suffix == ".pth":
        torch.save(state, path)
    else:
        save_file({name: tensor.contiguous() for name, tensor in state.items()}, path)
    autoencoder.save_pretrained(tmp_path / "folder" / "vae")
    single, folder = make("wan", path), make("wan", tmp_path / "folder")
    assert single.fingerprint() == folder.fingerprint()
    assert torch.equal(single.encode(clip(5)), folder.encode(clip(5)))
    assert single.mean[0].item() == pytest.approx(-0.7571)
    assert single.deviation[-1].item() == pytest.approx(1.9160)


def test_fingerprints_tell_codecs_weights_and_statistics_apart(folders, tmp_path):
    prints = [make(name, folders[name]).fingerprint() for name in NAMES]
    autoencoder = tiny_wan()
    autoencoder.register_to_config(latents_std=[1.0] * 16)
    autoencoder.save_pretrained(tmp_path)
    prints.append(make("wan", tmp_path).fingerprint())
    assert len(set(prints)) == len(prints)


def test_half_precision_files_are_loaded_as_float32(tmp_path):
    tiny_flux().half().save_pretrained(tmp_path)
    assert {p.dtype for p in make("flux", tmp_path).parameters()} == {torch.float32}


def damaged_folder(tmp_path, change):
    tiny_wan().save_pretrained(tmp_path)
    state = load_file(tmp_path / TENSORS)
    change(state)
    save_file(state, tmp_path / TENSORS)
    return tmp_path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda state: state.pop("encoder.conv_in.bias"), "encoder.conv_in.bias is missing"),
        (lambda state: state.update(extra=torch.ones(1)), "extra is .1., it should be absent"),
        (lambda state: state.update({"quant_conv.bias": torch.ones(2)}), "quant_conv.bias is .2.,"),
    ],
)
def test_a_wrong_tensor_is_named(tmp_path, change, message):
    with pytest.raises(DataError, match=message):
        make("wan", damaged_folder(tmp_path, change))


def test_weights_of_another_kind_are_refused(folders, tmp_path):
    with pytest.raises(DataError, match="is of an AutoencoderKL, not an AutoencoderKLWan"):
        make("wan", folders["flux"])
    with pytest.raises(DataError, match=r"is not a folder with config\.json"):
        make("flux", tmp_path)
    from diffusers import AutoencoderKLWan

    slower = AutoencoderKLWan(base_dim=4, num_res_blocks=1, temperal_downsample=[True] * 3)
    slower.save_pretrained(tmp_path / "slower")
    with pytest.raises(DataError, match=r"Wan 2\.1, and .* another model"):
        make("wan", tmp_path / "slower")


def test_wan_2_2_is_refused_by_its_version_before_weights_are_read(tmp_path):
    (tmp_path / "config.json").write_text(
        json.dumps({"_class_name": "AutoencoderKLWan", "patch_size": 2, "z_dim": 48})
    )
    with pytest.raises(DataError, match=r"holds that of Wan 2\.2"):
        make("wan", tmp_path)
    state = {"encoder.conv1.weight": torch.zeros(8, 12, 3, 3, 3), "conv2.weight": torch.zeros(48)}
    torch.save(state, tmp_path / "Wan2.2_VAE.pth")
    with pytest.raises(DataError, match=r"holds that of Wan 2\.2"):
        make("wan", tmp_path / "Wan2.2_VAE.pth")


@pytest.mark.parametrize(
    ("configuration", "message"),
    [
        ([], "is not a configuration"),
        ({"dim_mult": []}, "makes no AutoencoderKLWan"),
        ({"dim_mult": "wide"}, "makes no AutoencoderKLWan"),
        ({"base_dim": -4}, "makes no AutoencoderKLWan"),
        ({"latents_std": ["1"] * 16}, "latents_std of its configuration must be 16 numbers"),
        ({"latents_mean": [0.0]}, "latents_mean of its configuration must be 16 numbers"),
    ],
)
def test_a_wrong_configuration_is_one_sentence(folders, tmp_path, configuration, message):
    shutil.copytree(folders["wan"], tmp_path / "wan")
    if configuration:
        configuration = json.loads((tmp_path / "wan/config.json").read_text()) | configuration
    (tmp_path / "wan/config.json").write_text(json.dumps(configuration))
    with pytest.raises(DataError, match=message) as caught:
        make("wan", tmp_path / "wan")
    assert "\n" not in str(caught.value)


def test_damaged_files_are_one_sentence(tmp_path):
    tiny_flux().save_pretrained(tmp_path)
    (tmp_path / TENSORS).write_bytes(b"no tensors")
    with pytest.raises(DataError, match="cannot be read"):
        make("flux", tmp_path)
    (tmp_path / "config.json").write_text("{")
    with pytest.raises(DataError, match="cannot be read"):
        make("flux", tmp_path)
    single = tmp_path / "vae.pth"
    for content in (b"", b"no tensors", pickle.dumps([1, 2])):
        single.write_bytes(content)
        with pytest.raises(DataError, match=r"vae\.pth") as caught:
            make("wan", single)
        assert "\n" not in str(caught.value)
    torch.save({"other": torch.ones(1)}, single)
    with pytest.raises(DataError, match=r"lacks encoder\.conv1\.weight"):
        make("wan", single)
    state = original_state(tiny_wan(num_res_blocks=2))
    del state["decoder.upsamples.5.residual.2.bias"]
    torch.save(state, single)
    with pytest.raises(DataError, match=r"up_blocks\.1\.resnets\.1\.conv1\.bias is missing"):
        make("wan", single)


class Malicious:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_code_in_a_pickle_is_never_run(tmp_path):
    torch.save({"conv1.weight": Malicious(tmp_path / "ran")}, tmp_path / "vae.pth")
    with pytest.raises(DataError, match="something other than tensors"):
        make("wan", tmp_path / "vae.pth")
    assert not (tmp_path / "ran").exists()


def test_without_a_network_one_sentence_says_what_to_do(monkeypatch, tmp_path):
    constants = "huggingface_hub.constants"
    monkeypatch.setattr(f"{constants}.HF_HUB_OFFLINE", True)
    monkeypatch.setattr(f"{constants}.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(DataError) as caught:
        catalog().create("codec", "wan")
    message = str(caught.value)
    assert message.startswith("codec 'wan': Wan-AI/")
    assert message.endswith("set codec.weights to its folder")
    assert "\n" not in message
    with pytest.raises(DataError, match=r"/nowhere/vae\.pth is not a local file or folder"):
        make("wan", "/nowhere/vae.pth")


@pytest.mark.parametrize("name", NAMES)
def test_without_diffusers_the_extra_is_named(monkeypatch, name):
    for module in [m for m in sys.modules if m.partition(".")[0] == "diffusers"]:
        monkeypatch.delitem(sys.modules, module)
    for module in ("wan", "flux", "pretrained"):
        monkeypatch.delitem(sys.modules, f"acwm_codecs.{module}", raising=False)
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(MissingExtraError, match=r"needs 'diffusers': pip install 'acwm\[codecs\]'"):
        catalog().create("codec", name)


@pytest.mark.parametrize("name", NAMES)
def test_a_recipe_takes_them_by_a_word(folders, name):
    recipe = compose("push_cube_small", [f"codec={name}", f"codec.weights={folders[name]}"])
    card = catalog().create("environment", "push_cube").card
    world_model = build_world_model(recipe, card)
    video = world_model.rollout(torch.rand(1, 3, 32, 32), torch.zeros(1, 6, 2), steps=1)
    assert video.shape == (1, 6, 3, 32, 32)


@pytest.mark.ci
def test_the_conformance_suite_takes_weights_by_a_word(folders):
    run = CliRunner().invoke(main, ["check", "wan", f"codec.weights={folders['wan']}"])
    assert run.exit_code == 0, run.output
    # All but the check of a reference, which it does not take.
    assert run.output.count("  ok ") == len(checks_of(CodecChecks)) - 1
    for word in ("weights=x", "model.layers=3"):
        refused = CliRunner().invoke(main, ["check", "wan", word])
        assert "sets no parameter of wan; write codec.PARAMETER=VALUE" in refused.output
    misspelt = CliRunner().invoke(main, ["check", "wan", "codec.weihgts=x"])
    assert "did you mean 'weights'?" in misspelt.output
