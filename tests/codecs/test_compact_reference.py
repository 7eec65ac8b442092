"""The compact codec with a reference: the same latents, and what stands still keeps its detail."""

import pytest
import torch
from safetensors.torch import load_file, save_file

from acwm_codecs.compact import Compact
from acwm_codecs.compact_reference import CompactReference
from acwm_codecs.train_codec import save
from acwm_core.errors import DataError


def scene(frames=13, size=64):
    """A square that moves over a ground with small coloured dots, `[1, T, 3, H, W]`."""
    rng = torch.Generator().manual_seed(0)
    ground = torch.full((3, size, size), 0.3)
    for y, x in torch.randint(0, size - 1, (60, 2), generator=rng).tolist():
        ground[:, y : y + 2, x : x + 2] = torch.rand(3, 1, 1, generator=rng)
    video = ground.repeat(1, frames, 1, 1, 1)
    for frame in range(frames):
        video[0, frame, :, 24:40, 2 * frame + 8 : 2 * frame + 24] = 1.0
    return video


def decibels(codec, video, rows=None):
    with torch.no_grad():
        errors = (codec(video) - video)[..., :rows, :].square().mean((0, 2, 3, 4))
    return (-10 * errors.log10()).mean().item()


@pytest.fixture(scope="module")
def codec():
    return CompactReference()


def test_its_latents_are_those_of_compact(codec):
    video = scene()
    with torch.no_grad():
        assert torch.equal(codec.encode(video), Compact().encode(video))


def test_what_stands_still_keeps_its_detail(codec):
    """Dots of two pixels, which no latent holds; but not what was there and has moved away."""
    video = scene()
    assert decibels(codec, video) > decibels(Compact(), video) + 3
    assert decibels(codec, video, rows=20) > decibels(Compact(), video, rows=20) + 6
    with torch.no_grad():
        last = codec.with_reference(video[:, 0]).decode(codec.encode(video))[0, -1]
    assert last[:, 26:38, 10:22].mean() < 0.5  # where the square was in the reference


def test_without_a_reference_it_decodes_about_as_compact_does(codec):
    video = torch.nn.functional.avg_pool2d(scene()[0], 9, 1, 4)[None]
    with torch.no_grad():
        alone, compact = (each.decode(each.encode(video)) for each in (codec, Compact()))
    assert (alone - compact).square().mean() < 0.002


def test_files_leave_out_the_encoder_that_ships(codec, tmp_path):
    """But not another one."""
    save(codec, tmp_path / "own.safetensors", {})
    smaller = (tmp_path / "own.safetensors").stat().st_size
    again = CompactReference(weights=str(tmp_path / "own.safetensors"))
    assert again.fingerprint() == codec.fingerprint()
    with torch.no_grad():
        again.encoder[0].weight.mul_(1.5)
    save(again, tmp_path / "other.safetensors", {})
    assert (tmp_path / "other.safetensors").stat().st_size > 1.4 * smaller
    other = CompactReference(weights=str(tmp_path / "other.safetensors"))
    assert not torch.equal(other.encode(scene()), codec.encode(scene()))


def test_files_without_coarse_layers_are_completed_by_those_that_ship_and_no_others(tmp_path):
    tuned, file = CompactReference(), tmp_path / "finer.safetensors"
    tuned.freeze_coarse()
    with torch.no_grad():
        tuned.decoder[6].first.weight.mul_(2)  # exact in half precision
    save(tuned, file, {})
    assert file.stat().st_size < 0.5 * CompactReference.shipped_weights().stat().st_size
    assert CompactReference(weights=str(file)).fingerprint() == tuned.fingerprint()
    state = load_file(file)
    state["completed_by"][0] += 1
    save_file(state, file)
    with pytest.raises(DataError, match="another version of acwm"):
        CompactReference(weights=str(file))


def test_weights_of_compact_are_not_taken_for_its_own(tmp_path):
    save_file(Compact().stored(), tmp_path / "compact.safetensors")
    with pytest.raises(DataError, match="does not hold its weights"):
        CompactReference(weights=str(tmp_path / "compact.safetensors"))
