"""The published layout: what comes in, and what is said of it."""

import itertools
import multiprocessing
import os
import signal

import numpy as np
import pytest
import torch

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.errors import DataError
from acwm_core.plugins import catalog
from acwm_formats import staging
from acwm_formats.check import check_dataset
from acwm_formats.published import Published
from acwm_formats.published_layout import read_entries
from tests.formats import release
from tests.formats.conftest import checksums, psnr
from tests.formats.conftest import load_published as load


def test_episodes_come_in_as_they_are(published, tmp_path):
    folder, made = published
    card = load(folder, tmp_path / "data")
    assert card.splits == {"train": 5, "ind_test": 2, "ood_test": 2}
    for split, theirs in zip(card.splits, made.values(), strict=True):
        episodes = EpisodeDataset(tmp_path / "data", split)
        for episode, (frames, actions) in zip(episodes, theirs, strict=True):
            assert psnr(episode.video, frames) > 31  # what yuv420p leaves of coloured edges
            assert psnr(episode.video[1:], frames[:-1]) < 28
            np.testing.assert_array_equal(episode.actions[:-1], actions[:-1])
            assert not episode.actions[-1].any()
            assert not episode.masks.any()
            assert episode.contacts.shape == (0, 3)
    assert [f for f in check_dataset(tmp_path / "data") if f.problem] == []


def test_the_card_says_what_it_is(published, tmp_path):
    card = load(published[0], tmp_path / "data")
    action = catalog().component("environment", "push_cube").load().card.action
    assert (card.environment.name, card.environment.fps) == ("push_cube", 10)
    assert card.environment.action.names == action.names
    assert card.environment.action.units == ("", "")
    assert (card.environment.action.low, card.environment.action.high) == ((-1, -1), (1, 1))
    assert "without instance masks" in card.environment.summary
    assert card.source["kind"] == "acwm-phys"
    assert card.source["name"] == "push_block"
    assert set(card.source["sha256"]) == {"train", "ind_test", "ood_test"}
    assert "normalised to [-1, 1]" in card.source["notes"][0]
    assert card.source["notes"][0] in (tmp_path / "data/README.md").read_text()
    assert DatasetCard.read(tmp_path / "data") == card


def test_lengths_that_disagree_are_listed_and_the_sound_parts_kept_if_asked(folder, tmp_path):
    frames, _ = release.moving_square(np.random.default_rng(3), 9, (64, 64))
    release.video(folder / "ind_train" / "episode_0.mp4", frames)  # decodes shorter

    def change(entries):
        entries[1]["length"] = 7
        entries[2]["actions"] = entries[2]["actions"][:8]
        entries[3]["length"] = 40

    release.rewrite(folder / "ind_train", change)
    with pytest.raises(DataError, match="4 of 9 recordings have defects") as told:
        load(folder, tmp_path / "data")
    for name, numbers in (("0", (12, 9)), ("1", (7, 12)), ("2", (8, 12)), ("3", (40, 12))):
        line = next(x for x in str(told.value).splitlines() if f"episode_{name}.mp4" in x)
        assert all(str(number) in line for number in numbers)
    assert load(folder, tmp_path / "data", on_defect="skip").splits["train"] == 1
    card = load(folder, tmp_path / "trimmed", on_defect="trim")
    assert EpisodeDataset(tmp_path / "trimmed", "train").lengths == [9, 7, 9, 12, 12]
    assert sum("usable parts" in note for note in card.source["notes"]) >= 4


def test_the_aggregate_counts_and_pieces_do_not(folder, tmp_path):
    entries = torch.load(folder / "ind_train" / "metadata.pt", weights_only=False)
    torch.save(entries[:2], folder / "ind_train" / "metadata_part_0.pt")
    torch.save(entries[2:4], folder / "ind_train" / "metadata_part_1.pt")
    card = load(folder, tmp_path / "data")
    assert card.splits["train"] == 5
    assert any("train: 2 pieces of metadata left aside" in note for note in card.source["notes"])
    (folder / "ind_train" / "metadata.pt").unlink()
    with pytest.raises(DataError, match=r"pieces of the metadata .* but no metadata\.pt"):
        Published().read(folder)


def test_paths_of_any_machine_and_numbers_of_any_kind(folder, tmp_path):
    def change(entries):
        entries[0]["video_path"] = "C:\\data\\ind_train\\episode_0.mp4"
        entries[1]["video_path"] = "episode_1.mp4"
        del entries[2]["video_path"], entries[2]["length"], entries[2]["seed"]
        entries[3]["actions"] = entries[3]["actions"].numpy().astype(np.float64)
        entries[4] |= {"length": np.int32(12), "reward": np.float32(1.5), "done": np.bool_(True)}

    release.rewrite(folder / "ind_train", change)
    (folder / "ind_train" / "spare.mp4").touch()
    card = load(folder, tmp_path / "data")
    assert EpisodeDataset(tmp_path / "data", "train").lengths == [12] * 5
    assert any("train: 1 videos are not in the metadata" in note for note in card.source["notes"])


def test_metadata_saved_under_numpy_1_is_read(folder):
    path = folder / "ind_train" / "metadata.pt"
    entries = torch.load(path, weights_only=False)
    entries[0]["actions"] = entries[0]["actions"].numpy()
    torch.save(entries, path, _use_new_zipfile_serialization=False)
    old = path.read_bytes().replace(b"numpy._core.multiarray", b"numpy.core.multiarray")
    assert old != path.read_bytes()
    path.write_bytes(old)
    np.testing.assert_array_equal(read_entries(path)[0].actions, entries[0]["actions"])


def test_large_videos_are_averaged_down(tmp_path):
    rng = np.random.default_rng(0)
    place = tmp_path / "pour_water" / "ind_test"
    place.mkdir(parents=True)
    frames, actions = release.moving_square(rng, 2, (1024, 1024), 4)
    release.video(place / "episode_0.mp4", frames)
    entry = {"video_path": "episode_0.mp4", "actions": torch.tensor(actions), "length": 2}
    torch.save([entry], place / "metadata.pt")
    card = load(place.parent, tmp_path / "data")
    assert (card.environment.name, card.environment.frame_size) == ("pour_water", (240, 240))
    smaller = load(place.parent, tmp_path / "small", size=64)
    assert smaller.environment.frame_size == (64, 64)
    mean = frames.reshape(2, 64, 16, 64, 16, 3).mean((2, 4))
    assert psnr(EpisodeDataset(tmp_path / "small", "ind_test")[0].video, mean) > 40
    with pytest.raises(DataError, match="cannot be enlarged"):
        load(place.parent, tmp_path / "large", size=2048)


def test_actions_of_another_size_take_the_variant_or_made_up_names(tmp_path):
    release.environment(tmp_path / "push_block", action_size=4, splits={"ind_test": 1}, length=3)
    card = load(tmp_path / "push_block", tmp_path / "variant")
    assert card.environment.name == "push_cube_two_pushers"
    assert any("a variant of push_cube" in note for note in card.source["notes"])
    release.environment(tmp_path / "My Robot", action_size=5, splits={"ind_test": 1}, length=3)
    card = load(tmp_path / "My Robot", tmp_path / "made_up")
    assert card.environment.name == "my_robot"
    assert card.environment.action.names[-1] == "action_4"
    assert any("names are action_0" in note for note in card.source["notes"])


def test_training_actions_beyond_the_bounds_widen_them(folder, tmp_path):
    release.rewrite(folder / "ind_train", lambda entries: entries[0]["actions"][3].fill_(1.25))
    card = load(folder, tmp_path / "data")
    assert card.environment.action.high == (1.25, 1.25)
    release.rewrite(folder / "ind_test", lambda entries: entries[0]["actions"][3].fill_(9))
    card = load(folder, tmp_path / "tested")
    assert card.environment.action.high == (1.25, 1.25)  # a test episode sets no bounds
    assert any("ind_test: " in note and " to 9 was cut" in note for note in card.source["notes"])


def test_a_whole_release_is_a_folder_per_environment(tmp_path):
    for place in ("rigid_dynamics/push_block", "kinematics/reacher"):
        release.environment(tmp_path / "release" / place, splits={"ind_test": 1}, length=3)
    found = Published().read(tmp_path / "release")
    assert {name: each.facts["name"] for name, each in found.items()} == {
        "reacher": "reacher",
        "push_cube": "push_block",
    }
    assert [*Published().read(tmp_path / "release/kinematics")] == ["reacher"]
    one = Published().read(tmp_path / "release/kinematics/reacher")
    assert one.name == "reacher"
    release.environment(tmp_path / "release/other/reacher", splits={"ind_test": 1}, length=3)
    with pytest.raises(DataError, match="is a second reacher"):
        Published().read(tmp_path / "release")
    with pytest.raises(DataError, match="not in the published layout"):
        Published().read(tmp_path / "nowhere")


class Counted:
    """Counts the calls of a function."""

    def __init__(self, function):
        self.function, self.calls = function, 0

    def __call__(self, *given):
        self.calls += 1
        return self.function(*given)


@pytest.mark.ci
def test_a_killed_import_resumes_where_it_was(published, tmp_path, monkeypatch):
    out, encode = tmp_path / "killed", staging.encode_frames
    calls = itertools.count()

    def dying(*given):
        if next(calls) == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return encode(*given)

    monkeypatch.setattr(staging, "encode_frames", dying)
    fork = multiprocessing.get_context("fork")
    running = fork.Process(target=load, args=(published[0], out), kwargs={"shard_episodes": 1})
    running.start()
    running.join()
    assert running.exitcode == -signal.SIGKILL
    assert list(out.glob(".importing/*.zip"))
    monkeypatch.setattr(staging, "encode_frames", counted := Counted(encode))
    load(published[0], out, shard_episodes=1)
    assert counted.calls < 2 * 9  # a video and its masks for each episode that was not there
    assert not (out / ".importing").exists()
    load(published[0], tmp_path / "whole", shard_episodes=1)
    assert checksums(out) == checksums(tmp_path / "whole")


def test_another_release_in_the_folder_is_refused(published, folder, tmp_path):
    load(published[0], tmp_path / "data")
    before = checksums(tmp_path / "data")
    release.rewrite(folder / "ind_train", lambda entries: entries.pop())
    with pytest.raises(DataError, match=r"holds another dataset: .*sha256"):
        load(folder, tmp_path / "data")
    with pytest.raises(DataError, match="it was recorded there, is simulated now"):
        generate("push_cube", tmp_path / "data", episodes={"train": 1}, size=64, workers=0)
    assert checksums(tmp_path / "data") == before
