"""The published layout, damaged or made to do harm: each gets a sentence and nothing is run."""

import pickle
from pathlib import Path

import pytest
import torch

from acwm_core.errors import DataError
from acwm_formats.published import Published
from tests.formats import release
from tests.formats.conftest import load_published as load
from tests.plugins import Attack

ROOT = Path(__file__).parents[2]


def spoilt(entries, mark):
    entries[0]["seed"] = Attack(mark)
    return entries


@pytest.mark.parametrize("zipped", [True, False])
def test_pickled_code_is_not_run(folder, tmp_path, zipped):
    path, mark = folder / "ind_train" / "metadata.pt", tmp_path / "mark"
    entries = spoilt(torch.load(path, weights_only=False), mark)
    torch.save(entries, path, _use_new_zipfile_serialization=zipped)
    with pytest.raises(DataError, match="nothing in it was run"):
        load(folder, tmp_path / "data")
    assert not mark.exists()
    assert not (tmp_path / "data").exists()
    torch.load(path, weights_only=False)  # the attack is real
    assert mark.exists()


@pytest.mark.parametrize(
    "content",
    [b"", b"hello", pickle.dumps([{"actions": 3}]), b"\x80\x02}q\x00.", b"PK\x03\x04" + b"\0" * 99],
    ids=["empty", "text", "pickle", "dict", "zip"],
)
def test_what_is_no_metadata_is_refused(folder, content):
    (folder / "ind_train" / "metadata.pt").write_bytes(content)
    with pytest.raises(DataError, match=r"metadata\.pt"):
        Published().read(folder)


def test_cut_metadata_is_refused(folder):
    path = folder / "ind_train" / "metadata.pt"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(DataError, match=r"metadata\.pt"):
        Published().read(folder)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"actions": torch.zeros(12)}, "no actions"),
        ({"actions": torch.zeros(12, 2, dtype=torch.int64)}, "no actions"),
        ({"actions": torch.eye(2).to_sparse()}, "no actions"),
        ({"actions": [[0.0, 0.0]]}, "no actions"),
        ({"actions": torch.full((12, 2), torch.nan)}, "not finite"),
        ({"length": "12"}, "has the length '12'"),
        ({"length": -1}, "has the length -1"),
        ({"video_path": "/data/.."}, "names no video"),
    ],
)
def test_entries_that_cannot_be_are_refused(folder, change, problem):
    release.rewrite(folder / "ind_test", lambda entries: entries[1].update(change))
    with pytest.raises(DataError, match=problem):
        Published().read(folder)


def test_videos_that_cannot_be_are_refused(folder, tmp_path):
    path = folder / "ind_train" / "episode_3.mp4"
    whole = path.read_bytes()
    playlist = f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:1,\n{folder}/ind_test/episode_0.mp4\n"
    for content in (whole[: len(whole) // 2], b"", b"text", playlist.encode()):
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"1 of 9 recordings has defects.*\n.*episode_3\.mp4"):
            load(folder, tmp_path / "data")
    path.unlink()
    with pytest.raises(DataError, match=r"episode_3\.mp4 cannot be read \(No such file"):
        load(folder, tmp_path / "data")
    path.write_bytes(whole)  # fixed, the import resumes
    assert load(folder, tmp_path / "data").splits["train"] == 5


def test_an_episode_of_one_frame_is_named(folder, tmp_path):
    release.rewrite(folder / "ind_train", lambda entries: entries[2].update(length=1))
    with pytest.raises(DataError, match=r"episode_2\.mp4: it claims 1 frames, but has 12"):
        load(folder, tmp_path / "data")


def test_actions_of_another_size_are_a_defect(folder, tmp_path):
    change = {"actions": torch.zeros(12, 3)}
    release.rewrite(folder / "ind_test", lambda entries: entries[1].update(change))
    with pytest.raises(DataError, match=r"episode_1\.mp4: its actions have 3 dimensions, not 2"):
        load(folder, tmp_path / "data")
