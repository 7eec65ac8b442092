"""Exports: what is written, read by others' tools, and that it comes back."""

import json
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import av
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_formats import lerobot_export
from acwm_formats.check import check_dataset
from acwm_formats.format import export_dataset
from acwm_formats.hdf5 import HDF5
from acwm_formats.lerobot import LeRobot
from acwm_formats.published import Published
from acwm_formats.recordings import import_dataset
from tests.formats.conftest import episodes_of, imported, psnr

ROOT = Path(__file__).parents[2]
CAMERA = "observation.images.main"


def export(data, out, exporter):
    return export_dataset(data, out, exporter, progress=False)


def decoded(path):
    with av.open(str(path)) as file:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])


def looks_like(shown, truth):
    """Whether little more is lost than colours at half the resolution, which MP4 players want."""
    stored = [av.VideoFrame.from_ndarray(frame).reformat(format="yuv420p") for frame in truth]
    halved = np.stack([frame.to_ndarray(format="rgb24") for frame in stored])
    return psnr(shown, truth) > psnr(halved, truth) - 1


@pytest.fixture(scope="module")
def lerobot(simulated, tmp_path_factory):
    return export(simulated, tmp_path_factory.mktemp("exports") / "lerobot", LeRobot())


@pytest.mark.ci
def test_the_published_layout_holds_the_dataset(simulated, tmp_path):
    export(simulated, tmp_path / "out", Published())
    for split, folder in (("train", "ind_train"), ("ind_test", "ind_test"), ("ood_test",) * 2):
        place = tmp_path / "out/rigid_dynamics/push_block" / folder
        entries = torch.load(place / "metadata.pt", weights_only=True)
        episodes = EpisodeDataset(simulated, split)
        action = episodes.card.environment.action
        assert len(entries) == len(episodes)
        for index, (entry, episode) in enumerate(zip(entries, episodes, strict=True)):
            assert entry["length"] == len(episode.video) == len(entry["actions"])
            assert (entry["episode_idx"], entry["seed"]) == (index, 0)
            assert entry["actions"].dtype == torch.float32
            low, high = np.array(action.low), np.array(action.high)
            raw = (entry["actions"].numpy() + 1) / 2 * (high - low) + low
            np.testing.assert_allclose(raw[:-1], episode.actions[:-1], atol=1e-6)
            assert not entry["actions"][-1].any()
            video = place / Path(entry["video_path"]).name
            assert looks_like(decoded(video), episode.video)


@pytest.mark.ci
def test_the_published_layout_comes_back(simulated, tmp_path):
    export(simulated, tmp_path / "out", Published())
    recorded = Published().read(tmp_path / "out/rigid_dynamics/push_block")
    card = import_dataset(recorded, tmp_path / "back", workers=0, progress=False)
    assert card.splits == DatasetCard.read(simulated).splits
    assert card.environment.action == DatasetCard.read(simulated).environment.action
    for ours, back in zip(episodes_of(simulated), episodes_of(tmp_path / "back"), strict=True):
        np.testing.assert_allclose(back.actions, ours.actions, atol=1e-6)
        assert looks_like(back.video, ours.video)


def test_hdf5_keeps_every_bit(simulated, tmp_path):
    export(simulated, tmp_path / "out", HDF5())
    files = {path.stem for path in (tmp_path / "out").iterdir()}
    assert files == {"train", "ind_test", "ood_test"}
    for split in files:
        with h5py.File(tmp_path / "out" / f"{split}.hdf5") as file:
            assert file.attrs["format"] == "acwm"
            card = DatasetCard.from_dict(json.loads(file.attrs["card"]))
            assert card == DatasetCard.read(simulated)
            assert file.attrs["episodes"] == len(file) == card.splits[split]
            for index, episode in enumerate(EpisodeDataset(simulated, split)):
                group = file[f"episode_{index:06d}"]
                assert group["video"].chunks == (1, 64, 64, 3)
                for name in ("video", "masks", "actions", "contacts"):
                    stored = group[name][()]
                    assert stored.dtype == getattr(episode, name).dtype
                    np.testing.assert_array_equal(stored, getattr(episode, name))
                assert set(group["states"]) == set(episode.states)
                for name, values in episode.states.items():
                    np.testing.assert_array_equal(group["states"][name][()], values)
                assert json.loads(group.attrs["factors"]) == episode.factors
                assert group.attrs["ood_label"] == (episode.ood_label or "")
                assert json.loads(group.attrs["spec"]) == episode.spec.to_dict()


@pytest.mark.ci
def test_hdf5_comes_back_whole(simulated, tmp_path):
    recorded = HDF5().read(export(simulated, tmp_path / "out", HDF5()))
    card = imported(recorded, tmp_path / "back")
    before = DatasetCard.read(simulated).environment
    for name in ("name", "summary", "action", "state", "instances", "frame_size", "fps"):
        assert getattr(card.environment, name) == getattr(before, name)
    for split in card.splits:
        ours, back = EpisodeDataset(simulated, split), EpisodeDataset(tmp_path / "back", split)
        for index, (one, other) in enumerate(zip(ours, back, strict=True)):
            for name in ("video", "masks", "actions", "contacts"):
                np.testing.assert_array_equal(getattr(other, name), getattr(one, name))
            assert other.masks.any()
            for name, values in one.states.items():
                np.testing.assert_array_equal(other.states[name], values)
            about, facts = ours.about(index), back.about(index)["facts"]
            assert facts["factors"] == about["factors"]
            assert facts.get("ood_label") == about["ood_label"]
    assert not [found for found in check_dataset(tmp_path / "back") if found.problem]
    again = HDF5().read(export(tmp_path / "back", tmp_path / "again", HDF5()))
    assert again.splits["train"][0].facts == recorded.splits["train"][0].facts


def test_hdf5_of_another_size_or_cut_has_the_labels_that_fit(simulated, tmp_path):
    recorded = HDF5().read(export(simulated, tmp_path / "out", HDF5()))
    small = imported(recorded, tmp_path / "small", size=32)
    assert small.environment.instances == ("unlabelled",)
    assert any("Masks and contacts were omitted" in note for note in small.source["notes"])
    imported(recorded, tmp_path / "slow", fps=5)
    one, half = (EpisodeDataset(path, "train")[0] for path in (simulated, tmp_path / "slow"))
    np.testing.assert_array_equal(half.video, one.video[::2])
    np.testing.assert_array_equal(half.masks, one.masks[::2])
    wanted = one.contacts[one.contacts[:, 0] % 2 == 0]
    np.testing.assert_array_equal(half.contacts, wanted // [2, 1, 1])
    assert len(wanted)


def test_lerobot_files_have_the_schema_of_version_3(lerobot, simulated):
    info = json.loads((lerobot / "meta/info.json").read_text())
    episodes = episodes_of(simulated)
    frames = sum(len(episode.video) for episode in episodes)
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (7, frames, 10)
    assert info["splits"] == {"train": "0:3", "ind_test": "3:5", "ood_test": "5:7"}
    assert info["data_path"] == "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    features = info["features"]
    rows = pq.read_table(lerobot / "data/chunk-000/file-000.parquet")
    assert set(rows.column_names) == set(features) - {CAMERA}
    for name in rows.column_names:
        kind, (size,) = rows.schema.field(name).type, features[name]["shape"]
        number = pa.type_for_alias(features[name]["dtype"])
        assert kind == (number if size == 1 else pa.list_(number, size))
        assert features[name]["names"] is None or len(features[name]["names"]) == size
    assert rows["index"].to_pylist() == list(range(frames))
    tasks = pq.read_table(lerobot / "meta/tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    assert tasks["task_index"].to_pylist() == [0]


def test_lerobot_rows_and_video_are_the_episodes(lerobot, simulated):
    rows = pq.read_table(lerobot / "data/chunk-000/file-000.parquet")
    index = pq.read_table(lerobot / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    video = decoded(lerobot / f"videos/{CAMERA}/chunk-000/file-000.mp4")
    names = json.loads((lerobot / "meta/info.json").read_text())["features"]["observation.state"]
    for episode, place in zip(episodes_of(simulated), index, strict=True):
        start, stop = place["dataset_from_index"], place["dataset_to_index"]
        assert stop - start == place["length"] == len(episode.video)
        part = rows.slice(start, place["length"])
        np.testing.assert_array_equal(part["action"].to_pylist(), episode.actions)
        assert set(part["episode_index"].to_pylist()) == {place["episode_index"]}
        times = np.arange(len(episode.video)) / 10
        np.testing.assert_allclose(part["timestamp"].to_pylist(), times, atol=1e-6)
        first = round(place[f"videos/{CAMERA}/from_timestamp"] * 10)
        assert round(place[f"videos/{CAMERA}/to_timestamp"] * 10) - first == place["length"]
        shown = video[first : first + place["length"]]
        assert looks_like(shown, episode.video)
        state = np.array(part["observation.state"].to_pylist())
        column = names["names"].index("pusher_position.0.1")
        expected = episode.states["pusher_position"][:, 0, 1]
        np.testing.assert_allclose(state[:, column], expected, rtol=1e-6)


def test_lerobot_statistics_are_those_of_the_rows(lerobot):
    rows = pq.read_table(lerobot / "data/chunk-000/file-000.parquet")
    stats = json.loads((lerobot / "meta/stats.json").read_text())
    for name in ("action", "observation.state", "timestamp", "index"):
        values = np.array(rows[name].to_pylist(), np.float64).reshape(len(rows), -1)
        np.testing.assert_allclose(stats[name]["mean"], values.mean(0), rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(stats[name]["std"], values.std(0), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(stats[name]["min"], values.min(0))
        np.testing.assert_allclose(stats[name]["max"], values.max(0))
        assert stats[name]["count"] == [len(rows)]
        inside = np.array(stats[name]["q01"]) <= np.array(stats[name]["q99"])
        assert inside.all()
    first = pq.read_table(lerobot / "meta/episodes/chunk-000/file-000.parquet").to_pylist()[0]
    values = np.array(rows["action"].to_pylist()[: first["length"]])
    np.testing.assert_allclose(first["stats/action/q90"], np.quantile(values, 0.9, axis=0))
    video = decoded(lerobot / f"videos/{CAMERA}/chunk-000/file-000.mp4") / 255
    mean = np.array(stats[CAMERA]["mean"])
    assert mean.shape == (3, 1, 1)
    np.testing.assert_allclose(mean[:, 0, 0], video.mean((0, 1, 2)), atol=0.01)


def test_lerobot_comes_back_with_names_units_and_bounds(lerobot, simulated, tmp_path):
    card = import_dataset(LeRobot().read(lerobot), tmp_path / "back", workers=0, progress=False)
    ours = DatasetCard.read(simulated)
    assert (card.splits, card.environment.action) == (ours.splits, ours.environment.action)
    assert card.environment.name == "push_cube"
    for mine, back in zip(episodes_of(simulated), episodes_of(tmp_path / "back"), strict=True):
        np.testing.assert_array_equal(back.actions, mine.actions)
        assert looks_like(back.video, mine.video)


def test_many_files_hold_what_one_does(lerobot, simulated, tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot_export, "DATA_MB", 0)
    monkeypatch.setattr(lerobot_export, "VIDEO_MB", 0)
    monkeypatch.setattr(lerobot_export, "CHUNK_FILES", 2)
    root = export(simulated, tmp_path / "many", LeRobot())
    names = [f"chunk-{i // 2:03d}/file-{i % 2:03d}" for i in range(7)]
    assert [f"{p.parent.name}/{p.stem}" for p in sorted(root.glob("data/*/*"))] == names
    assert [f"{p.parent.name}/{p.stem}" for p in sorted(root.glob("videos/*/*/*"))] == names
    for folder, place in (("one", lerobot), ("many_back", root)):
        imported(LeRobot().read(place), tmp_path / folder, environment="same", shard_episodes=32)
    both = episodes_of(tmp_path / "one"), episodes_of(tmp_path / "many_back")
    for a, b in zip(*both, strict=True):
        np.testing.assert_array_equal(a.actions, b.actions)
        assert psnr(a.video, b.video) > 38  # key frames lie otherwise


def test_large_states_are_features_of_their_own(simulated, tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot_export, "SHORT", 1)
    root = export(simulated, tmp_path / "out", LeRobot())
    features = json.loads((root / "meta/info.json").read_text())["features"]
    rows = pq.read_table(root / "data/chunk-000/file-000.parquet")
    episode = episodes_of(simulated)[0]
    assert "observation.states.pusher_position" in features
    stored = rows["observation.states.pusher_position"].to_pylist()[: len(episode.video)]
    flat = episode.states["pusher_position"].reshape(len(episode.video), -1)
    np.testing.assert_allclose(stored, flat, rtol=1e-6)
    whole = json.loads((root / "meta/stats.json").read_text())
    assert "observation.states.pusher_position" in whole
    index = pq.read_schema(root / "meta/episodes/chunk-000/file-000.parquet").names
    assert not any(name.startswith("stats/observation.states") for name in index)
    back = import_dataset(LeRobot().read(root), tmp_path / "back", workers=0, progress=False)
    fields = {field.name: field.shape for field in back.environment.state}
    assert fields["observation.states.pusher_position"] == (flat.shape[1],)


def test_exports_are_whole_or_not_there(simulated, tmp_path):
    out = tmp_path / "out"

    class Failing(HDF5):
        def write(self, given):
            super().write(given)
            raise OSError(28, "No space left on device")

    with pytest.raises(DataError, match=r"cannot write to .*out \(No space left on device\)"):
        export(simulated, out, Failing())
    assert list(tmp_path.iterdir()) == []
    out.mkdir()
    (out / "mine").touch()
    with pytest.raises(DataError, match="already exists"):
        export(simulated, out, HDF5())
    assert [path.name for path in out.iterdir()] == ["mine"]
    with pytest.raises(DataError, match="no dataset in"):
        export(tmp_path / "nowhere", tmp_path / "other", HDF5())


@pytest.mark.ci
def test_a_killed_export_leaves_nothing_under_its_name(simulated, tmp_path):
    out = tmp_path / "out"
    code = """
        import os, signal
        from pathlib import Path
        from acwm_core.cli import main
        usual = Path.replace
        def replace(self, to):  # by which the folder would take its name
            return os.kill(os.getpid(), signal.SIGKILL) if self.is_dir() else usual(self, to)
        Path.replace = replace
        main()
    """
    words = ["data", "export", "lerobot", str(simulated), "--out", str(out)]
    command = [sys.executable, "-c", textwrap.dedent(code), *words]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, check=False)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    assert not out.exists()
    assert list(tmp_path.glob(".out.partial/out/videos/*/*/*"))
    export(simulated, out, LeRobot())
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
