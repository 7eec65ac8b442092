"""Episodes and clips in random access: the right frames and actions, padding, clear refusals."""

import pickle
import shutil
from itertools import pairwise

import numpy as np
import pytest
import torch
from conftest import EPISODES

from acwm_core.data.clips import (
    ClipDataset,
    hold_out,
    list_windows,
    take_fraction,
    window_starts,
)
from acwm_core.data.dataset import EpisodeDataset, Manifest
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.errors import DataError, RecipeError
from acwm_core.recipe.check import check_section


def test_every_episode_is_its_specs(square_data):
    square = make_environment("square")
    for split, count in EPISODES.items():
        dataset = EpisodeDataset(square_data, split)
        assert len(dataset) == count
        assert dataset.lengths == [21] * count
        for index, episode in enumerate(dataset):
            assert (episode.spec.split, episode.spec.index) == (split, index)
            truth = simulate(square, episode.spec)
            np.testing.assert_array_equal(episode.video, truth.video)
            np.testing.assert_array_equal(dataset.actions(index), truth.actions)
            assert dataset.about(index)["ood_label"] == truth.ood_label
            part = dataset.video(index, 4, 9)
            np.testing.assert_array_equal(part, truth.video[4:9].transpose(0, 3, 1, 2))


@pytest.mark.ci
def test_indices_behave_like_a_lists(square_data):
    dataset = EpisodeDataset(square_data, "train")
    assert dataset[-1].spec.index == 10
    for beyond in (11, -12):
        with pytest.raises(IndexError):
            dataset[beyond]
    copy = pickle.loads(pickle.dumps(dataset))
    np.testing.assert_array_equal(copy.actions(7), dataset.actions(7))


@pytest.mark.parametrize(("frames", "stride"), [(9, 4), (13, 1), (21, 4), (5, 7)])
def test_clips_are_the_episodes_windows(square_data, frames, stride):
    episodes = EpisodeDataset(square_data, "ood_test")
    clips = ClipDataset(episodes, frames=frames, stride=stride)
    expected = [(e, s) for e in range(5) for s in range(0, 21 - frames + 1, stride)]
    assert [tuple(row) for row in clips.windows.tolist()] == expected
    assert len(clips) == len(expected)
    for index, (e, start) in enumerate(expected):
        clip, episode = clips[index], episodes[e]
        assert clip["video"].dtype == torch.uint8
        truth = episode.video[start : start + frames].transpose(0, 3, 1, 2)
        np.testing.assert_array_equal(clip["video"].numpy(), truth)
        assert clip["actions"].dtype == torch.float32
        np.testing.assert_array_equal(
            clip["actions"][:-1], episode.actions[start : start + frames - 1]
        )
        assert not clip["actions"][-1].any()  # it would lead out of the clip


def test_a_clip_longer_than_its_episode_rests_at_the_end(square_data):
    episodes = EpisodeDataset(square_data, "ind_test")
    clips = ClipDataset(episodes, frames=30)
    assert len(clips) == 2
    clip = clips[1]
    assert clip["video"].shape == (30, 3, 32, 32)
    np.testing.assert_array_equal(clip["video"][:21], episodes.video(1))
    assert (clip["video"][21:] == clip["video"][20]).all()
    np.testing.assert_array_equal(clip["actions"][:21], episodes.actions(1))
    assert not clip["actions"][20:].any()


@pytest.mark.parametrize("frames", [9, 30])
def test_a_batch_is_its_clips(square_data, frames):
    """Taken from whole episodes by numpy, in any order and with repetition."""
    episodes = EpisodeDataset(square_data, "train")
    clips = ClipDataset(episodes, frames=frames)
    chosen = [len(clips) - 1, 0, 5, 0]
    batch = clips.batch(chosen)
    assert batch["video"].shape == (4, frames, 3, 32, 32)
    for row, index in enumerate(chosen):
        episode, start = clips.windows[index].tolist()
        rows = np.minimum(np.arange(start, start + frames), 20)
        truth = episodes[episode].video.transpose(0, 3, 1, 2)[rows]
        np.testing.assert_array_equal(batch["video"][row], truth)
        actions = episodes[episode].actions[rows]
        actions[-1] = 0
        np.testing.assert_array_equal(batch["actions"][row], actions)


def test_chosen_episodes_alone_give_clips(square_data):
    episodes = EpisodeDataset(square_data, "train")
    training, held_out = hold_out(len(episodes), 3)
    parts = [ClipDataset(episodes, frames=9, indices=part) for part in (training, held_out)]
    assert set(parts[0].windows[:, 0]) == set(range(8))
    assert set(parts[1].windows[:, 0]) == {8, 9, 10}
    assert len(parts[0]) + len(parts[1]) == len(ClipDataset(episodes, frames=9))


def test_holding_out_everything_is_refused():
    assert hold_out(5, 0) == (range(5), range(5, 5))
    assert hold_out(1000, None) == (range(968), range(968, 1000))
    assert hold_out(50, None) == (range(45), range(45, 50))
    assert hold_out(2, None) == (range(1), range(1, 2))
    assert hold_out(1, None) == (range(1), range(1, 1))
    with pytest.raises(DataError, match="validation_episodes=32 leaves nothing of 20"):
        hold_out(20, 32)


def test_fractions_of_the_episodes_are_nested_and_always_the_same():
    episodes = range(1955)
    parts = [take_fraction(episodes, fraction) for fraction in (1.0, 0.5, 0.25)]
    assert [len(part) for part in parts] == [1955, 978, 489]
    assert set(parts[2]) < set(parts[1]) < set(parts[0])
    assert all(list(part) == sorted(part) for part in parts)
    assert parts[1] == take_fraction(episodes, 0.5)
    # Spread over the whole, and no every-other: a dataset may be ordered.
    assert 200 < sum(index < 978 for index in parts[2]) < 290
    assert len({later - earlier for earlier, later in pairwise(parts[1])}) > 3
    assert len(take_fraction(range(3), 0.01)) == 1
    assert set(take_fraction(range(10, 20), 0.5)) < set(range(10, 20))


def test_windows_of_episodes_of_any_length():
    assert list(window_starts(66, 37, 4)) == [0, 4, 8, 12, 16, 20, 24, 28]
    assert list(window_starts(37, 37, 4)) == [0]
    assert list(window_starts(5, 37, 4)) == [0]
    assert list_windows([5, 12, 10], 10, 2).tolist() == [[0, 0], [1, 0], [1, 2], [2, 0]]
    assert list_windows([5], 10, 2, []).shape == (0, 2)


def test_missing_splits_and_unfinished_data_are_refused(square_data, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(square_data, folder)
    shard = folder / "train/shard-00001.tar"
    lines = (folder / "train/manifest.jsonl").read_text().splitlines(keepends=True)
    (folder / "train/manifest.jsonl").write_text("".join(lines[:1] + lines[2:]))
    with pytest.raises(DataError, match=r"train of .* holds 7 of its 11 episodes: run the"):
        EpisodeDataset(folder, "train")
    (folder / "train/manifest.jsonl").write_text("nonsense\n")
    with pytest.raises(DataError, match=r"manifest\.jsonl is damaged"):
        EpisodeDataset(folder, "train")
    (folder / "train/manifest.jsonl").write_text("".join(lines))
    shard.unlink()
    dataset = EpisodeDataset(folder, "train")
    assert dataset.actions(0).any()
    with pytest.raises(DataError, match=r"shard-00001\.tar is missing: run the command"):
        dataset.video(5)
    with pytest.raises(DataError, match="no split 'test', only train, ind_test, ood_test"):
        EpisodeDataset(folder, "test")
    with pytest.raises(DataError, match="there is no dataset"):
        EpisodeDataset(tmp_path / "nowhere", "train")


def test_reading_leaves_a_manifest_alone_that_is_being_written(square_data, tmp_path):
    shutil.copytree(square_data / "train", tmp_path / "train")
    path = tmp_path / "train/manifest.jsonl"
    torn = path.read_text()[:-30]
    path.write_text(torn)
    assert len(Manifest(tmp_path / "train").records) == 2
    assert path.read_text() == torn


def test_equal_data_has_equal_checksums(square_data):
    assert (
        EpisodeDataset(square_data, "train").checksum == Manifest(square_data / "train").checksum()
    )
    splits = [EpisodeDataset(square_data, split).checksum for split in EPISODES]
    assert len(set(splits)) == 3


@pytest.mark.parametrize(
    "wrong", [{"batch_size": 0}, {"clip_frames": 1}, {"window_stride": 0}, {"workers": -1}]
)
def test_impossible_settings_are_refused(wrong):
    with pytest.raises(RecipeError, match=rf"data.{next(iter(wrong))}="):
        check_section("data", {"path": "data/square", **wrong})
