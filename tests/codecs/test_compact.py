"""The codecs that ship with the package: their weights, their folding and their latents."""

import math

import pytest
import torch
from safetensors.torch import save_file

from acwm_codecs.compact import Compact, Fine, fold, unfold
from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.errors import DataError
from acwm_core.files import training_record
from acwm_core.plugins import catalog


@pytest.fixture(scope="module", params=[Compact, Fine])
def codec(request):
    return request.param()


def simulated_video(size, split, index, name="push_cube"):
    """The beginning of an episode of a seed that no training used, `[1, T, 3, H, W]`."""
    environment = catalog().create("environment", name, size=size)
    spec = EpisodeSpec(name, split, index, seed=12345, options={"size": size})
    video = torch.from_numpy(simulate(environment, spec, frames=37).video)
    return video.permute(0, 3, 1, 2)[None].float() / 255


def test_folding_keeps_every_frame_exactly():
    video = torch.rand(2, 9, 3, 16, 24)
    groups = fold(video)
    assert groups.shape == (6, 12, 16, 24)
    torch.testing.assert_close(unfold(groups.unflatten(0, (2, 3))), video)


@pytest.mark.parametrize(
    ("name", "size", "split", "decibels"),
    [
        ("push_cube", 64, "ind_test", {"compact": 31, "fine": 34}),
        ("push_cube", 64, "ood_test", {"compact": 29, "fine": 32}),
        pytest.param(
            "push_cube", 240, "ind_test", {"compact": 33, "fine": 35}, marks=pytest.mark.slow
        ),
        ("reacher", 64, "ind_test", {"compact": 32, "fine": 34}),
        pytest.param(
            "reacher", 64, "ood_test", {"compact": 32, "fine": 34}, marks=pytest.mark.slow
        ),
    ],
)
def test_shipped_weights_reconstruct_scenes_they_never_saw(codec, name, size, split, decibels):
    errors = list[float]()
    for index in range(2 if size == 64 else 1):
        video = simulated_video(size, split, index, name)
        with torch.inference_mode():
            errors.append((codec(video) - video).square().mean().item())
    assert -10 * math.log10(sum(errors) / len(errors)) > decibels[codec.name]


def test_latents_of_real_video_are_normalised(codec):
    with torch.inference_mode():
        latents = torch.cat([codec.encode(simulated_video(64, "train", i)) for i in range(3)])
    assert latents.mean((0, 1, 3, 4)).abs().max() < 0.6
    assert 0.6 < latents.std().item() < 1.4


def test_the_weights_are_small_and_say_how_they_were_made(codec):
    assert codec.shipped_weights().stat().st_size <= 10_000_000
    record = training_record(codec.shipped_weights())
    assert {"data", "seed", "steps", "batch", "peak_learning_rate"} <= record.keys()


def test_wrong_weights_are_refused_with_a_sentence(tmp_path):
    with pytest.raises(DataError, match="no weights file"):
        Compact(weights=str(tmp_path / "absent.safetensors"))
    save_file({"x": torch.zeros(1)}, tmp_path / "other.safetensors")
    with pytest.raises(DataError, match="does not hold its weights"):
        Compact(weights=str(tmp_path / "other.safetensors"))
    (tmp_path / "broken.safetensors").write_bytes(b"not safetensors")
    with pytest.raises(DataError, match="does not hold its weights"):
        Compact(weights=str(tmp_path / "broken.safetensors"))


def test_weights_that_are_not_finite_are_refused(tmp_path):
    from safetensors.torch import load_file

    weights = load_file(Compact.shipped_weights())
    name = max(weights)
    weights[name].view(-1)[0] = math.nan
    save_file(weights, tmp_path / "nan.safetensors")
    with pytest.raises(DataError, match=rf"weights that are not finite \({name}\)"):
        Compact(weights=str(tmp_path / "nan.safetensors"))
