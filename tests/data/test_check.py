"""`check_dataset` passes what is sound and names what is not."""

import io
import json
import shutil

import numpy as np
import pytest
from forging import forge, npy, problems

from acwm_core.data.card import MANIFEST
from acwm_formats.check import check_dataset


@pytest.fixture
def data(square_data, tmp_path):
    return shutil.copytree(square_data, tmp_path / "data")


def test_a_sound_dataset_passes_and_is_replayed(data):
    findings = list(check_dataset(data))
    assert [f for f in findings if f.problem] == []
    whats = [f.what for f in findings]
    assert "train/shard-00002.tar" in whats
    assert "replay of train 0" in whats
    assert "replay of train 10" in whats


def test_a_flipped_bit_and_a_cut_are_found_and_the_rest_is_still_checked(data):
    flipped, cut = data / "train/shard-00000.tar", data / "train/shard-00001.tar"
    content = bytearray(flipped.read_bytes())
    content[2000] ^= 1
    flipped.write_bytes(content)
    cut.write_bytes(cut.read_bytes()[:-700])
    found = problems(data)
    assert "the checksum of the file differs" in found.pop("train/shard-00000.tar")
    assert "bytes" in found.pop("train/shard-00001.tar")
    assert found == {}


def test_missing_and_foreign_files_are_named(data):
    (data / "train/shard-00001.tar").unlink()
    (data / "ind_test/notes.txt").write_text("mine")
    found = problems(data)
    assert "missing" in found["train/shard-00001.tar"]
    assert "notes.txt" in found[f"ind_test/{MANIFEST}"]


def test_a_gap_in_the_manifest_is_found(data):
    path = data / "train" / MANIFEST
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[1:]))
    assert "shard-00000.tar is not recorded" in problems(data)[f"train/{MANIFEST}"]


def test_a_shard_that_was_exchanged_together_with_its_record_is_found(data):
    path = data / "ind_test" / MANIFEST
    record = json.loads(path.read_text())
    record["sha256"] = "0" * 64
    path.write_text(json.dumps(record) + "\n")
    assert "not those that the card records" in problems(data)[f"ind_test/{MANIFEST}"]


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (
            lambda a: a + np.float32(100) * (np.arange(len(a)) < 3)[:, None].astype(np.float32),
            "out of its bounds",
        ),
        (lambda a: np.where(np.arange(len(a))[:, None] == 2, np.float32("nan"), a), "not finite"),
        (lambda a: a[:, :1], "actions are"),
        (lambda a: a[:-1], "actions has 20 rows for 21 frames"),
    ],
    ids=["bounds", "nan", "columns", "rows"],
)
def test_actions_that_cannot_be_are_refused(data, make, problem):
    def change(info, content):
        if info.name == "train-000001.actions.npy":
            content = npy(make(np.load(io.BytesIO(content))))
        return info, content

    forge(data, change)
    assert problem in problems(data, replays=0)["train/shard-00000.tar"]


def test_a_spec_of_another_dataset_is_refused(data):
    def change(info, content):
        if info.name == "train-000001.json":
            about = json.loads(content)
            about["spec"]["seed"] = 99
            content = json.dumps(about).encode()
        return info, content

    forge(data, change)
    assert "another spec" in problems(data)["train/shard-00000.tar"]


def test_a_replay_may_differ_by_rounding(data, monkeypatch):
    """As on another kind of processor: one pixel, by one level."""
    from acwm_formats import check

    simulate = check.simulate

    def elsewhere(*arguments, **options):
        made = simulate(*arguments, **options)
        made.video[3, 4, 5, 0] ^= 1
        return made

    monkeypatch.setattr(check, "simulate", elsewhere)
    replayed = [each for each in check.check_dataset(data) if each.what.startswith("replay")]
    assert replayed
    assert all(each.problem is None and "rounding" in each.note for each in replayed)


def test_an_episode_that_the_simulator_did_not_make_fails_its_replay(data):
    def change(info, content):
        if info.name == "train-000000.actions.npy":
            content = npy(np.load(io.BytesIO(content)) * np.float32(0.5))
        return info, content

    forge(data, change)
    assert "the episode differs in" in problems(data)["replay of train 0"]
