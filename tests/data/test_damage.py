"""A damaged or missing shard met in training or encoding is named in one sentence."""

import itertools
import shutil

import pytest
from blocks import Blocks

from acwm_core.data.clips import ClipDataset
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.latents import LatentClipDataset, encode_windows
from acwm_core.data.loader import ClipLoader, ClipSampler
from acwm_core.data.shards import open_shard
from acwm_core.errors import DataError

FRAMES = 9
NAME = "shard-00001.tar"
SENTENCE = r"shard .*shard-00001\.tar is damaged \("


@pytest.fixture
def data(square_data, tmp_path):
    """Eleven episodes in shards of four."""
    return shutil.copytree(square_data, tmp_path / "data")


def flip(data):
    """Change a byte of a video in the second shard; all else stays readable."""
    path = data / "train" / NAME
    member = open_shard(path).episodes[1]["video.mkv"]
    content = bytearray(path.read_bytes())
    content[member.offset + member.size // 2] ^= 1
    path.write_bytes(content)


def cut(data):
    """Cut the second shard in the middle, so that nothing of it can be read."""
    path = data / "train" / NAME
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def read_all(data, **settings):
    clips = ClipDataset(EpisodeDataset(data, "train"), frames=FRAMES)
    loader = ClipLoader(clips, ClipSampler(len(clips), batch_size=4), **settings)
    return list(itertools.islice(loader, -(-len(clips) // 4)))


@pytest.mark.parametrize("harm", [flip, cut])
@pytest.mark.parametrize("workers", [0, 1])
def test_training_ends_with_the_shards_name(data, workers, harm):
    harm(data)
    with pytest.raises(DataError, match=SENTENCE) as raised:
        read_all(data, workers=workers)
    assert "\n" not in str(raised.value)
    assert "run the command that made it again" in str(raised.value)


def test_a_missing_shard_is_named(data):
    (data / "train" / NAME).unlink()
    with pytest.raises(DataError, match=r"shard-00001\.tar is missing"):
        read_all(data)


def encode(data):
    encode_windows(EpisodeDataset(data, "train"), Blocks(), frames=FRAMES, progress=False)


@pytest.mark.ci
def test_encoding_names_it_and_goes_on_when_it_is_mended(data, square_data):
    flip(data)
    with pytest.raises(DataError, match=SENTENCE):
        encode(data)
    shutil.copy(square_data / "train" / NAME, data / "train" / NAME)
    encode(data)
    encode(whole := shutil.copytree(square_data, data.parent / "whole"))
    files = [sorted(folder.rglob("*.npy")) for folder in (data, whole)]
    assert [file.read_bytes() for file in files[0]] == [file.read_bytes() for file in files[1]]


def test_latents_without_their_actions_are_no_clips(data):
    """They were encoded while the shard was whole."""
    encode(data)
    cut(data)
    with pytest.raises(DataError, match=SENTENCE):
        LatentClipDataset(EpisodeDataset(data, "train"), Blocks().fingerprint(), frames=FRAMES)
