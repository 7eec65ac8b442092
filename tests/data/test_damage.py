"""A damaged shard met in training: named in one sentence, or replaced, always by the same clips."""

import itertools
import shutil
import warnings

import numpy as np
import pytest
from blocks import Blocks

from acwm_core.data.encoding import encode_windows
from acwm_core.data.episodes import ClipDataset, EpisodeDataset
from acwm_core.data.latents import LatentClipDataset
from acwm_core.data.loader import ResumableLoader
from acwm_core.data.shards import open_shard
from acwm_core.errors import DamagedShardError, DataError

FRAMES = 9
NAME = "shard-00001.tar"
SENTENCE = r"shard .*shard-00001\.tar is damaged \("


@pytest.fixture
def data(square_data, tmp_path):
    """Eleven episodes in shards of four."""
    return shutil.copytree(square_data, tmp_path / "data")


def flip(data, episode):
    """Change a byte of the video of an episode in the second shard; all else stays readable."""
    path = data / "train" / NAME
    member = open_shard(path).episodes[episode - 4]["video.mkv"]
    content = bytearray(path.read_bytes())
    content[member.offset + member.size // 2] ^= 1
    path.write_bytes(content)


def cut(data):
    """Cut the second shard in the middle, so that nothing of it can be read."""
    path = data / "train" / NAME
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def clips_of(data):
    return ClipDataset(EpisodeDataset(data, "train"), frames=FRAMES)


def batches(dataset, passes=1, **settings):
    loader = ResumableLoader(dataset, batch_size=4, seed=3, **settings)
    steps = passes * -(-len(dataset) // loader.sampler.clips_per_step)
    return loader, list(itertools.islice(loader, steps))


@pytest.mark.parametrize("workers", [0, 1])
def test_training_ends_with_the_shards_name(data, workers):
    flip(data, 5)
    with pytest.raises(DataError, match=SENTENCE) as raised:
        batches(clips_of(data), workers=workers)
    assert "\n" not in str(raised.value)
    assert "run the command that made it again" in str(raised.value)


@pytest.mark.parametrize("harm", ["a byte", "half"])
def test_skipping_replaces_the_damaged_clips_alone(data, square_data, harm):
    cut(data) if harm == "half" else flip(data, 5)
    lost = range(4, 8) if harm == "half" else [5]
    sound, damaged = clips_of(square_data), clips_of(data)
    _, expected = batches(sound, passes=3)
    with pytest.warns(UserWarning, match=f"damaged clips are replaced by others: {SENTENCE}"):
        loader, got = batches(damaged, passes=3, skip_damaged=True)
    assert len(got) == len(expected)
    order = loader.sampler
    order.position = 0
    replaced = 0
    stand_ins = {}
    for indices, one, other in zip(order, got, expected, strict=False):
        for row, index in enumerate(indices):
            same = np.array_equal(one["video"][row], other["video"][row])
            if int(sound.windows[index, 0]) not in lost:
                assert same
                continue
            replaced += 1
            video = one["video"][row].numpy().tobytes()
            assert stand_ins.setdefault(index, video) == video  # the same whenever it comes
    assert loader.replaced.total() == replaced > 0
    found = {
        clip["video"].numpy().tobytes(): i
        for i, clip in enumerate(map(sound.__getitem__, range(len(sound))))
    }
    assert {int(sound.windows[found[video], 0]) for video in stand_ins.values()}.isdisjoint(lost)


def test_damage_takes_no_steps_from_a_rank(data):
    cut(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for rank in range(2):
            loader, got = batches(clips_of(data), rank=rank, world_size=2, skip_damaged=True)
            assert len(got) * 8 == loader.sampler.position


def test_a_missing_shard_is_not_skipped(data):
    (data / "train" / NAME).unlink()
    with pytest.raises(DataError, match=r"shard-00001\.tar is missing"):
        batches(clips_of(data), skip_damaged=True)


def test_if_everything_is_damaged_training_ends(data):
    for path in (data / "train").glob("*.tar"):
        path.write_bytes(b"rubbish")
    with pytest.raises(DataError, match="too many clips are damaged"):
        batches(clips_of(data), skip_damaged=True)


def encode(data, **settings):
    encode_windows(
        EpisodeDataset(data, "train"), Blocks(), frames=FRAMES, progress=False, **settings
    )


def latents_of(data, **settings):
    episodes = EpisodeDataset(data, "train")
    return LatentClipDataset(episodes, Blocks().fingerprint(), frames=FRAMES, **settings)


def test_encoding_names_it_or_leaves_it_out_until_it_is_fixed(data, square_data):
    whole = data.parent / "whole"
    shutil.copytree(square_data, whole)
    encode(whole)
    sound = latents_of(whole)
    flip(data, 5)
    with pytest.raises(DamagedShardError, match=SENTENCE):
        encode(data)
    encode(data, skip_damaged=True)
    with pytest.raises(DataError, match="is not encoded"):
        latents_of(data)  # nothing is missing unless one agreed to it
    latents = latents_of(data, skip_damaged=True)
    for index in range(len(latents)):
        if latents.windows[index, 0] == 5:
            with pytest.raises(DamagedShardError, match=rf"{NAME} was damaged"):
                latents[index]
        else:
            np.testing.assert_array_equal(latents[index]["latents"], sound[index]["latents"])
    with pytest.warns(UserWarning, match="damaged clips are replaced"):
        loader, got = batches(latents, passes=2, skip_damaged=True)
    assert loader.replaced.total() == 2 * sum(latents.windows[:, 0] == 5)
    assert all(batch["latents"].isfinite().all() for batch in got)

    with pytest.raises(DamagedShardError, match=SENTENCE):
        encode(data)
    shutil.copy(square_data / "train" / NAME, data / "train" / NAME)
    encode(data)
    assert not list(data.rglob("*.incomplete.npy"))
    mended = latents_of(data)
    for index in range(len(sound)):
        np.testing.assert_array_equal(mended[index]["latents"], sound[index]["latents"])


def test_latents_outlive_a_shard_whose_actions_are_lost(data):
    """Encoded while it was whole: without its actions there is still no clip of it."""
    encode(data)
    cut(data)
    with pytest.raises(DamagedShardError, match=SENTENCE):
        latents_of(data)
    clips = latents_of(data, skip_damaged=True)
    with pytest.warns(UserWarning, match="damaged clips are replaced"):
        loader, _ = batches(clips, skip_damaged=True)
    lost = np.isin(clips.windows[:, 0], range(4, 8)).sum()
    assert loader.replaced.total() >= lost
