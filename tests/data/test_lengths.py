"""Clips of short episodes: as long as these are, in batches and steps of one length."""

import itertools
from collections import Counter

import numpy as np
import pytest
from blocks import Blocks

from acwm_core.data.clips import ClipDataset, shared_lengths
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.latents import LatentClipDataset, encode_windows
from acwm_core.data.loader import ClipLoader, ClipSampler
from acwm_core.env.environment import ActionSpec
from acwm_formats.arrays import write_dataset
from tests.recordings import Noise

FRAMES = (13, 11, 21, 9, 8, 3, 12)
"""Of the episodes; windows of 13 frames start every 4."""

LENGTHS = [13, 9, 13, 13, 13, 9, 5, 5, 9]
"""Of the clips, in whole groups of 4 after the first frame; the third episode gives three."""


@pytest.fixture(scope="module")
def episodes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "short"
    action = ActionSpec(("x", "y"), ("m", "m"), (-1, -1), (1, 1), "delta")
    write_dataset(
        folder,
        {"train": Noise(FRAMES)},
        name="short",
        action=action,
        fps=5,
        progress=False,
    )
    return EpisodeDataset(folder, "train")


def test_clips_end_where_their_episodes_do(episodes):
    clips = ClipDataset(episodes, frames=13, temporal_stride=4)
    assert clips.lengths.tolist() == LENGTHS
    for index, (episode, start) in enumerate(clips.windows.tolist()):
        frames, clip = min(LENGTHS[index], FRAMES[episode]), clips[index]
        assert clip["video"].shape[0] == clip["actions"].shape[0] == LENGTHS[index]
        truth = episodes[episode]
        shown = truth.video[start : start + frames].transpose(0, 3, 1, 2)
        np.testing.assert_array_equal(clip["video"][:frames], shown)
        actions = truth.actions[start : start + frames - 1]
        np.testing.assert_array_equal(clip["actions"][: frames - 1], actions)
        assert not clip["actions"][frames - 1 :].any()


@pytest.mark.parametrize("remembers", [False, True])
def test_latents_are_those_of_the_clip_alone(episodes, remembers):
    codec = Blocks(remembers=remembers)
    encode_windows(episodes, codec, frames=13, stride=4, progress=False)
    latents = LatentClipDataset(episodes, codec.fingerprint(), frames=13, temporal_stride=4)
    clips = ClipDataset(episodes, frames=13, temporal_stride=4)
    assert latents.lengths.tolist() == LENGTHS
    for index in range(len(clips)):
        alone = codec.encode(clips[index]["video"][None].float() / 255)[0]
        np.testing.assert_allclose(latents[index]["latents"], alone, rtol=1e-3, atol=1e-3)
        np.testing.assert_array_equal(latents[index]["actions"], clips[index]["actions"])


def test_no_batch_mixes_lengths(episodes):
    clips = ClipDataset(episodes, frames=13, temporal_stride=4)
    with pytest.raises(ValueError, match=r"clips of \[9, 13\] frames"):
        clips.batch([0, 1])


def test_the_loader_gives_every_clip_whole_and_resumes(episodes):
    clips = ClipDataset(episodes, frames=13, temporal_stride=4)
    samplers = (ClipSampler(9, batch_size=2, seed=3, lengths=LENGTHS) for _ in range(2))
    first, second = (ClipLoader(clips, sampler) for sampler in samplers)
    whole = [batch["video"].numpy().copy() for batch in itertools.islice(first, 5)]
    order = iter(ClipSampler(9, batch_size=2, seed=3, lengths=LENGTHS))
    for video, indices in zip(whole, order, strict=False):
        assert len(video) == 2
        np.testing.assert_array_equal(video, clips.batch(indices)["video"])
    second.order.position = 3 * 2
    rest = [batch["video"].numpy() for batch in itertools.islice(second, 2)]
    for ours, theirs in zip(rest, whole[3:], strict=True):
        np.testing.assert_array_equal(ours, theirs)


def steps_of(count, **settings):
    """The clips of each optimiser step, of all ranks and batches together."""
    ranks, accumulated = settings.pop("ranks", 1), settings.get("accumulated", 1)
    lengths = settings["lengths"]
    samplers = [
        iter(ClipSampler(len(lengths), rank=rank, world_size=ranks, **settings))
        for rank in range(ranks)
    ]
    return [
        [clip for _ in range(accumulated) for sampler in samplers for clip in next(sampler)]
        for _ in range(count)
    ]


MANY = np.array([37] * 50 + [21] * 7 + [5] * 3)[np.random.default_rng(0).permutation(60)]


def test_every_clip_comes_equally_often_and_spread_evenly():
    steps = steps_of(2 * 60, batch_size=4, seed=1, lengths=MANY)
    assert all(len(set(MANY[step].tolist())) == 1 for step in steps)
    # Each cycle of as many steps as clips takes every clip as often as a step has clips.
    for cycle in (steps[:60], steps[60:]):
        counts = Counter(clip for step in cycle for clip in step)
        assert set(counts.values()) == {4}
        assert len(counts) == 60
    # 3 of 60 steps take the rarest length, once in each third.
    rare = [number for number, step in enumerate(steps) if MANY[step[0]] == 5]
    assert [number // 20 for number in rare] == list(range(6))


def test_steps_are_the_same_on_other_devices():
    one = steps_of(40, batch_size=8, seed=1, lengths=MANY)
    assert one == steps_of(40, batch_size=2, seed=1, lengths=MANY, ranks=4)
    assert one == steps_of(40, batch_size=2, seed=1, lengths=MANY, ranks=2, accumulated=2)


def test_equal_lengths_change_nothing():
    plain = iter(ClipSampler(11, batch_size=3, seed=4))
    alike = iter(ClipSampler(11, batch_size=3, seed=4, lengths=[37] * 11))
    assert [next(plain) for _ in range(20)] == [next(alike) for _ in range(20)]


@pytest.mark.parametrize("seed", range(3))
def test_batches_of_many_lengths_hold_different_clips(seed):
    lengths = 1 + 4 * np.random.default_rng(seed).integers(15, 75, 100)
    shared = shared_lengths(lengths, 16)
    assert (shared <= lengths).all()
    assert (shared >= 0.75 * lengths).all()
    assert set(shared) <= set(lengths)  # whole latent frames, as they were
    sampler = iter(ClipSampler(100, batch_size=16, seed=seed, lengths=shared))
    distinct = [len(set(next(sampler))) for _ in range(100)]
    assert np.mean(distinct) > 13
    before = iter(ClipSampler(100, batch_size=16, seed=seed, lengths=lengths))
    assert np.mean([len(set(next(before))) for _ in range(100)]) < 4


def test_clips_are_shortened_only_where_it_helps():
    assert shared_lengths(np.array([37, 37, 33, 5]), 2).tolist() == [37, 37, 33, 5]
    assert shared_lengths(np.array([37, 33, 33, 29, 5]), 2).tolist() == [33, 33, 33, 29, 5]
    assert shared_lengths(np.array([29, 37, 5, 9]), 99).tolist() == [29, 29, 5, 9]
    assert shared_lengths(np.array(LENGTHS), 1).tolist() == LENGTHS


def test_shortened_clips_are_the_start_of_the_whole_ones(episodes):
    settings = {"frames": 21, "temporal_stride": 1}
    whole, clips = (
        ClipDataset(episodes, **settings),
        ClipDataset(episodes, **settings, per_length=2),
    )
    assert whole.lengths.tolist() == [13, 11, 21, 9, 8, 3, 12]
    assert clips.lengths.tolist() == [12, 9, 21, 9, 8, 3, 12]
    batch = clips.batch([1, 3])
    np.testing.assert_array_equal(batch["video"][0], whole[1]["video"][:9])
    np.testing.assert_array_equal(batch["actions"][0, :8], whole[1]["actions"][:8])
    assert not batch["actions"][0, 8].any()
