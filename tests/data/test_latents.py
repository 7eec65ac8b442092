"""Latents of clips: what the codec gives for each clip, cached, never confused, resumable."""

import os
import pickle
import shutil

import numpy as np
import pytest
import torch
from blocks import Blocks

from acwm_core.data.clips import ClipDataset
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.latents import LatentClipDataset, compresses, encode_windows
from acwm_core.errors import AcwmWarning, DataError, ShapeError


@pytest.fixture
def data(tmp_path):
    generate(
        "square",
        tmp_path / "data",
        episodes={"train": 7},
        workers=0,
        shard_episodes=3,
        progress=False,
    )
    return EpisodeDataset(tmp_path / "data", "train")


def encode(data, codec, **settings):
    encode_windows(data, codec, progress=False, **settings)
    return LatentClipDataset(data, codec.fingerprint(), **settings)


@pytest.mark.parametrize(
    ("codec", "frames", "stride"),
    [
        (Blocks(), 13, 4),
        (Blocks(), 13, 3),
        (Blocks(), 11, 4),
        (Blocks(2), 7, 6),
        (Blocks(), 30, 4),
        (Blocks(remembers=True), 13, 4),
    ],
)
def test_each_clip_is_what_the_codec_gives(data, codec, frames, stride):
    latents = encode(data, codec, frames=frames, stride=stride)
    clips = ClipDataset(data, frames=frames, stride=stride)
    assert len(latents) == len(clips)
    np.testing.assert_array_equal(latents.windows, clips.windows)
    for index in range(len(clips)):
        expected = codec.encode(clips[index]["video"][None].float() / 255)[0]
        item = latents[index]
        assert item["latents"].dtype == torch.float16
        torch.testing.assert_close(item["latents"].float(), expected, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(item["actions"], clips[index]["actions"], rtol=0, atol=0)


def test_overlapping_clips_share_the_work_of_a_memoryless_codec(data):
    shared, apart = Blocks(), Blocks(remembers=True)
    encode(data, shared, frames=13, stride=4)
    encode(data, apart, frames=13, stride=4)
    assert apart.encoded == 7 * 3 * 13
    assert shared.encoded == 7 * (3 + 21)


def test_chosen_episodes_alone_are_read(data):
    whole = encode(data, Blocks(), frames=9)
    part = LatentClipDataset(data, Blocks().fingerprint(), frames=9, indices=[6, 2])
    places = [np.flatnonzero(whole.windows[:, 0] == episode) for episode in (6, 2)]
    for index, place in enumerate(np.concatenate(places)):
        torch.testing.assert_close(part[index], whole[int(place)], rtol=0, atol=0)


@pytest.mark.parametrize("rest", [0.5, 0.0])
def test_latents_that_are_cut_off_while_they_are_read_are_one_sentence(data, rest):
    """A map of such a file would end the process by SIGBUS."""
    latents = encode(data, Blocks(), frames=9)
    last = len(latents) - 1
    assert latents[last]["latents"].isfinite().all()
    for file in data.path.rglob("*.npy"):
        os.truncate(file, int(rest * file.stat().st_size))
    with pytest.raises(DataError, match=r"damaged \(its end is cut off\): delete the file and enc"):
        latents[last]


def test_a_second_call_encodes_nothing_and_an_interrupted_one_goes_on(data):
    codec = Blocks()
    folder = encode_windows(data, codec, frames=9, progress=False)
    done = codec.encoded
    files = sorted(folder.glob("*.npy"))
    contents = [file.read_bytes() for file in files]
    assert len(files) == 3
    assert encode_windows(data, codec, frames=9, progress=False) == folder
    assert codec.encoded == done
    files[1].unlink()
    (folder / ".shard-00001.npy.1.partial").write_bytes(b"half")
    encode_windows(data, codec, frames=9, progress=False)
    assert [file.read_bytes() for file in sorted(folder.glob("*.npy"))] == contents
    assert 0 < codec.encoded - done < done
    assert not list(folder.glob("*.partial")) + list(folder.glob(".*partial"))


def test_latents_of_another_codec_windows_or_data_are_not_taken(data):
    encode_windows(data, Blocks(), frames=9, progress=False)
    with pytest.raises(
        DataError, match=r"not encoded by the codec blocks-4-False-2.*there are lat"
    ):
        LatentClipDataset(data, Blocks(gain=2.0).fingerprint(), frames=9)
    with pytest.raises(DataError, match="windows of 13 frames every 4"):
        LatentClipDataset(data, Blocks().fingerprint(), frames=13)
    with pytest.raises(DataError, match="every 2"):
        LatentClipDataset(data, Blocks().fingerprint(), frames=9, stride=2)
    data.checksum = "0" * 64
    with pytest.raises(DataError, match="not encoded"):
        LatentClipDataset(data, Blocks().fingerprint(), frames=9)


def test_values_that_float16_cannot_hold_are_refused(data):
    for gain in (1e9, float("nan")):
        with pytest.raises(DataError, match="not finite or too large"):
            encode_windows(data, Blocks(gain=gain), frames=9, progress=False)
        with pytest.raises(DataError, match="not encoded"):
            LatentClipDataset(data, Blocks(gain=gain).fingerprint(), frames=9)


def test_frames_that_the_codec_cannot_encode_are_refused(data):
    codec = Blocks()
    codec.spatial_stride = 64
    with pytest.raises(ShapeError, match="multiples of 64"):
        encode_windows(data, codec, frames=9, progress=False)


def test_the_codec_is_left_as_it_was(data):
    codec = Blocks().train()
    encode_windows(data, codec, frames=9, progress=False)
    assert codec.training


def test_other_processes_read_the_same_without_a_copy_of_the_latents(data):
    latents = encode(data, Blocks(), frames=9)
    mapped = latents[0]
    sent = pickle.dumps(latents)
    assert len(sent) < sum(file.stat().st_size for file in data.path.rglob("*.npy"))
    torch.testing.assert_close(pickle.loads(sent)[0], mapped, rtol=0, atol=0)


def test_only_latents_smaller_than_frames_are_worth_keeping():
    assert compresses(Blocks())
    wide = Blocks()
    wide.channels = 3 * 8 * 8 * 4
    assert not compresses(wide)


def test_latents_of_data_that_cannot_be_written_to_are_kept_in_the_cache(
    data, tmp_path, monkeypatch
):
    """As on a shared disk; training reads them from where they are."""
    beside = encode(data, Blocks(), frames=9)[3]["latents"]
    shutil.rmtree(data.path / "latents")
    monkeypatch.setenv("ACWM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr("acwm_core.data.latents.is_writable", lambda _: False)
    with pytest.warns(AcwmWarning, match=r"cannot be written to.*ACWM_CACHE.*cache_latents=false"):
        folder = encode_windows(data, Blocks(), frames=9)
    assert folder.is_relative_to(tmp_path / "cache")
    assert not (data.path / "latents").exists()
    kept = LatentClipDataset(data, Blocks().fingerprint(), frames=9)[3]["latents"]
    torch.testing.assert_close(kept, beside, rtol=0, atol=0)
    monkeypatch.setenv("ACWM_CACHE", str(data.path / "card.yaml" / "cache"))
    with pytest.raises(DataError, match=r"train without them, with data\.cache_latents=false"):
        encode_windows(data, Blocks(gain=2.0), frames=9, progress=False)
