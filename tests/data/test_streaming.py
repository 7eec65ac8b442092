"""Streaming shards with webdataset: the clips of random access, equal steps, no full copy."""

import itertools
import shutil
from collections import Counter

import numpy as np
import pytest
from blocks import Blocks
from serving import served

from acwm_core.data import remote
from acwm_core.data.clips import ClipDataset
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.latents import LatentClipDataset, encode_windows
from acwm_core.data.loader import ClipLoader, ClipSampler
from acwm_core.data.streaming import ClipStream
from acwm_core.errors import DataError

WINDOWS = {"frames": 9, "stride": 4}


@pytest.fixture
def copied(square_data, tmp_path):
    return shutil.copytree(square_data, tmp_path / "data")


def clips_of(data, **settings):
    return ClipDataset(EpisodeDataset(data, "train"), **WINDOWS, **settings)


def streaming(clips, *, workers=0, shuffle_buffer=2000, **batches):
    sampler = ClipSampler(len(clips), **batches)
    stream = ClipStream(clips, sampler, shuffle_buffer=shuffle_buffer)
    return ClipLoader(stream, sampler, workers=workers)


def taken(loader, batches):
    """The clips of some batches, as bytes by which they are known."""
    drawn = itertools.islice(loader, batches)
    pairs = [zip(batch["video"], batch["actions"], strict=True) for batch in drawn]
    return [v.numpy().tobytes() + a.numpy().tobytes() for pair in pairs for v, a in pair]


def known(clips):
    return {
        item["video"].numpy().tobytes() + item["actions"].numpy().tobytes(): index
        for index, item in enumerate(clips[index] for index in range(len(clips)))
    }


@pytest.mark.parametrize("workers", [0, 2])
def test_a_pass_has_every_clip_of_random_access_once(square_data, workers):
    clips = clips_of(square_data)
    numbers = known(clips)
    loader = streaming(clips, batch_size=1, seed=3, workers=workers, shuffle_buffer=7)
    if workers:  # which take their passes each in its own time
        assert {numbers[clip] for clip in taken(loader, 12 * len(clips))} == set(range(len(clips)))
        return
    first = [numbers[clip] for clip in taken(loader, len(clips))]
    assert sorted(first) == list(range(len(clips)))
    assert first != sorted(first)
    again = streaming(clips, batch_size=1, seed=3, shuffle_buffer=7)
    assert [numbers[clip] for clip in taken(again, len(clips))] == first
    other = streaming(clips, batch_size=1, seed=4, shuffle_buffer=7)
    assert [numbers[clip] for clip in taken(other, len(clips))] != first


def test_latents_of_a_streamed_clip_are_the_cached_ones(copied):
    clips, codec = clips_of(copied), Blocks()
    encode_windows(clips.episodes, codec, **WINDOWS, progress=False)
    cached = LatentClipDataset(clips.episodes, codec.fingerprint(), **WINDOWS)
    numbers = known(clips)
    batch = next(iter(streaming(clips, batch_size=3, shuffle_buffer=4)))
    for video, actions in zip(batch["video"], batch["actions"], strict=True):
        index = numbers[video.numpy().tobytes() + actions.numpy().tobytes()]
        latents = codec.encode(video[None].float() / 255)[0]
        np.testing.assert_allclose(latents.detach(), cached[index]["latents"].float(), atol=2e-3)


@pytest.mark.parametrize(("ranks", "workers"), [(1, 2), (2, 0), (5, 0)])
def test_all_clips_come_equally_often_where_shards_do_not_divide_by_readers(
    square_data, ranks, workers
):
    """As in a whole number of passes over three shards, the last of which is smaller."""
    clips, passes = clips_of(square_data), 10
    numbers, seen = known(clips), Counter[int]()
    for rank in range(ranks):
        batches = {"batch_size": 3, "seed": 2, "rank": rank, "world_size": ranks}
        loader = streaming(clips, workers=workers, shuffle_buffer=9, **batches)
        steps = passes * len(clips) // (3 * ranks)
        drawn = taken(loader, steps)
        assert loader.order.position == steps * 3 * ranks
        seen.update(numbers[clip] for clip in drawn)
    readers = ranks * max(1, workers)
    shard = np.array([clips.episodes.shard_of(episode) for episode in clips.windows[:, 0]])
    counts = np.array([seen[index] for index in range(len(clips))])
    often = np.array([counts[shard == number].mean() for number in range(3)])
    assert abs(often - passes).max() <= 1 + readers / 3  # a shard per reader is under way
    assert abs(counts - passes).max() <= 2 + readers / 2


def test_only_chosen_episodes_come(square_data):
    clips = clips_of(square_data, indices=[1, 5])
    assert {known(clips)[clip] for clip in taken(streaming(clips, batch_size=2), 20)} == set(
        range(len(clips))
    )


def test_a_batch_has_clips_of_one_length(square_data):
    clips = ClipDataset(EpisodeDataset(square_data, "train"), frames=9, stride=4, temporal_stride=4)
    clips.lengths[::3] = 5
    loader = streaming(clips, batch_size=2, shuffle_buffer=9)
    lengths = [batch["video"].shape[:2] for batch in itertools.islice(loader, len(clips))]
    assert {tuple(length) for length in lengths} == {(2, 9), (2, 5)}


def test_shards_of_a_url_are_not_kept(square_data, tmp_path, monkeypatch):
    monkeypatch.setenv(remote.CACHE, str(tmp_path / "cache"))
    monkeypatch.setattr(remote, "WAITS", (0, 0, 0))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "passing"))
    (tmp_path / "passing").mkdir()
    numbers = known(clips_of(square_data))
    with served(square_data) as server:
        server.faults = {"/train/shard-00001.tar": ["cut", 503]}
        clips = clips_of(server.url)
        drawn = taken(streaming(clips, batch_size=1, shuffle_buffer=5), len(clips))
        server.faults = {f"/train/shard-0000{n}.tar": [404] for n in range(3)}
        with pytest.raises(DataError, match=r"there is no .*shard-0000\d\.tar"):
            taken(streaming(clips, batch_size=1), 1)
    assert sorted(numbers[clip] for clip in drawn) == list(range(len(numbers)))
    assert not list(tmp_path.rglob("*.tar"))


def test_a_batch_may_be_larger_than_a_pass(square_data):
    clips = clips_of(square_data, indices=[1])
    assert len(taken(streaming(clips, batch_size=2 * len(clips) + 1), 3)) == 6 * len(clips) + 3


@pytest.mark.parametrize("workers", [0, 1])
def test_damage_ends_the_stream_with_the_shards_name(copied, workers):
    shard = copied / "train" / "shard-00001.tar"
    shard.write_bytes(shard.read_bytes()[: shard.stat().st_size // 2])
    clips = clips_of(copied)
    settings = {"batch_size": 1, "workers": workers}
    with pytest.raises(DataError, match=r"shard-00001\.tar is damaged"):
        taken(streaming(clips, **settings), 2 * len(clips))
