"""Texts of every format are kept as facts of the episodes, and no model reads them."""

import json
import shutil

import gymnasium
import h5py
import mcap.reader
import mcap.writer
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zarr
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import ActionSpec
from acwm_formats.arrays import Recording, write_dataset
from acwm_formats.hdf5 import HDF5
from acwm_formats.lerobot import LeRobot
from acwm_formats.mcap_logs import MCAP, write_example
from acwm_formats.rollouts import rollouts
from acwm_formats.texts import LONGEST, text_fact
from acwm_formats.videos import Videos
from acwm_formats.zarr_replay import ZarrReplay
from tests.formats.corpus import arrays
from tests.formats.corpus.cases import Case, three
from tests.formats.test_from_lerobot import REFERENCE
from tests.formats.test_several_in_one import SAYS, file_of
from tests.formats.test_videos import film, write
from tests.formats.toy_envs import Dot

PLAIN = Case("plain", three(rate=20), rate=20)
LENGTHS = [len(episode.numbers) for episode in PLAIN.episodes]
TASKS = ["push the a", "push the b", "push the ü"]
BY_ROW = [text for text, length in zip(TASKS, LENGTHS, strict=True) for _ in range(length)]


def test_a_text_is_one_or_those_that_follow_each_other():
    assert text_fact(["reach", None, b"reach", "", float("nan")]) == "reach"
    assert text_fact(["reach", "push", "reach"]) == ["reach", "push"]
    assert text_fact([b"\xff\xd8"]) is None
    assert text_fact([1.0, "reach"]) is None
    assert text_fact(["x" * (LONGEST + 1)]) is None
    assert text_fact([]) is None


def test_texts_are_kept_as_facts(tmp_path):
    for name in "abc":
        film(tmp_path / f"{name}.mp4", 0)
        lines = [f"push the {name},{'reach' if k < 4 else 'push'},{k}" for k in range(8)]
        write(tmp_path / f"{name}.csv", "\n".join(["task,phase,x", *lines]))
    words = ["data", "import", "videos", str(tmp_path), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(main, [*words, "--workers", "0", "--test-episodes", "1"])
    assert done.exit_code == 0, done.output
    said = " ".join(done.output.split())
    assert "kept as facts of the episodes: task, phase. No model reads them." in said
    facts = EpisodeDataset(tmp_path / "out", "train").about(1)["facts"]
    assert facts == {"task": "push the b", "phase": ["reach", "push"]}


def test_texts_in_hdf5_are_kept(tmp_path):
    path, _ = arrays.libero(tmp_path, PLAIN)
    with h5py.File(path, "a") as file:
        file["data/demo_0"].attrs["success"] = "yes"
        file["data/demo_0"].attrs["model_file"] = "<mujoco/>" * 1000
    found = HDF5().read(path)
    assert found.splits[0].facts == {"success": "yes", "language_instruction": "put it down"}
    assert any("No model reads them" in note for note in found.notes)


def test_a_text_stands_once_in_npz_and_json(tmp_path):
    for name in "ab":
        film(tmp_path / f"{name}.mp4", 0)
    np.savez(tmp_path / "a.npz", action=np.zeros((8, 2)), task="push it")
    write(tmp_path / "b.json", json.dumps({"action": [[0, 0]] * 8, "task": "pull", "who": "me"}))
    found = Videos().read(tmp_path).splits
    assert found[0].facts == {"task": "push it"}
    assert found[1].facts == {"task": "pull", "who": "me"}


def test_columns_that_the_first_table_lacks_are_named(tmp_path):
    for name, more in (("a", ""), ("b", ",gripper,operator")):
        film(tmp_path / f"{name}.mp4", 0)
        values = ",1,Ada" if more else ""
        write(
            tmp_path / f"{name}.csv", "\n".join([f"x{more}", *[f"{k}{values}" for k in range(8)]])
        )
    found = Videos().read(tmp_path).splits
    assert found[1].facts == {"operator": "Ada"}
    assert found[1].notes == ("columns that the first table lacks were left out: gripper",)


def test_texts_beside_the_numbers_of_hdf5_are_kept(tmp_path):
    path, options = arrays.mapped(tmp_path, PLAIN)
    with h5py.File(path, "a") as file:
        for place, length in enumerate(LENGTHS):
            file[f"runs/{place}/obs/phase"] = [b"reach"] * 2 + [b"push"] * (length - 2)
            file[f"runs/{place}/note"] = TASKS[place]
    facts = HDF5().read(path, **options).splits[1].facts
    assert facts == {"phase": ["reach", "push"], "note": "push the b"}


@pytest.mark.parametrize(("group", "beside"), [("/", "/"), ("data", "meta")])
def test_texts_of_episodes_in_a_row_are_kept(tmp_path, group, beside):
    path = file_of(tmp_path / "all.h5", SAYS["lengths"], group=group, beside=beside)
    with h5py.File(path, "a") as file:
        file[f"{beside}/task"] = ["a", "b", "c", "d"]
        count = len(file[group]["action"])
        file[f"{group}/row"] = [f"row {place}" for place in range(count)]
    found = HDF5().read(path, video="pixels", actions="action", rate=10).splits
    assert found[2].facts["task"] == "c"
    assert found[0].facts["row"] == [
        f"row {place}" for place in range(len(found[0].actions.values))
    ]


@pytest.mark.parametrize(("version", "dtype"), [(2, "U20"), (2, str), (3, str), (2, "S20")])
def test_texts_in_zarr_are_kept(tmp_path, version, dtype):
    path, options = arrays.replay(tmp_path, PLAIN, version)
    group = zarr.open_group(str(path), mode="a")
    coded = (lambda text: text.encode()) if dtype == "S20" else str
    for name, texts in (("data/task", BY_ROW), ("meta/scene", TASKS)):
        array = group.create_array(name, shape=(len(texts),), dtype=dtype, chunks=(2,))
        array[:] = np.array([*map(coded, texts)], object if dtype is str else dtype)
    found = ZarrReplay().read(path, **options)
    assert [dict(found.splits[place].facts) for place in range(3)] == [
        {"task": text, "scene": text} for text in TASKS
    ]
    assert any("facts of the episodes: task, scene." in note for note in found.notes)


def test_texts_of_lerobot_are_kept(tmp_path):
    root = shutil.copytree(REFERENCE / "video", tmp_path / "toy")
    info = json.loads((root / "meta/info.json").read_text())
    info["features"]["instruction"] = {"dtype": "string", "shape": [1]}
    (root / "meta/info.json").write_text(json.dumps(info))
    data, places = (root / f"{n}/chunk-000/file-000.parquet" for n in ("data", "meta/episodes"))
    rows, index = pq.read_table(data), pq.read_table(places)
    said = [f"go {number}" for number in rows.column("episode_index").to_pylist()]
    pq.write_table(rows.append_column("instruction", pa.array(said)), data)
    scenes = [f"kitchen {place}" for place in range(len(index))]
    pq.write_table(index.append_column("scene", pa.array(scenes)), places)
    found = LeRobot().read(root)
    facts = found.splits[1].facts
    assert (facts["instruction"], facts["scene"]) == ("go 1", "kitchen 1")
    assert not any("left out" in note for note in found.notes)
    assert any("episodes: tasks, scene, instruction. No model" in note for note in found.notes)


def test_texts_in_logs_are_kept(tmp_path):
    path = tmp_path / "run.mcap"
    write_example(path, np.random.default_rng(0), 6)
    with (tmp_path / "texts.mcap").open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start()
        for schema, channel, message in _messages(path):
            known = writer.register_schema(schema.name, schema.encoding, schema.data)
            topic = writer.register_channel(channel.topic, "json", known)
            writer.add_message(topic, message.log_time, message.data, message.log_time)
        told = writer.register_channel(
            "/task", "json", writer.register_schema("std_msgs/String", "jsonschema", b"{}")
        )
        writer.add_message(told, 0, b'{"data": "push it"}', 0)
        writer.add_metadata("operator", {"name": "Ada"})
        writer.finish()
    path.unlink()
    found = MCAP().read(tmp_path)
    assert found.splits[0].facts == {"task": "push it", "operator.name": "Ada"}
    assert any("episodes: operator.name, task. No model" in note for note in found.notes)
    assert not any("left out" in note for note in found.notes)


def _messages(path):
    with path.open("rb") as file:
        yield from [*mcap.reader.make_reader(file).iter_messages()]


class Told(gymnasium.ObservationWrapper):
    """Says what to do, as MiniGrid does."""

    def __init__(self, env):
        super().__init__(env)
        space = {"place": env.observation_space, "mission": gymnasium.spaces.Text(40)}
        self.observation_space = gymnasium.spaces.Dict(space)

    def observation(self, observation):
        return {"place": observation, "mission": "leave the frame"}


def test_texts_that_an_environment_shows_are_kept():
    found = rollouts(Told(Dot(render_mode="rgb_array")), "dot", (1, 1), frames=4)
    assert found.splits["train"][0].facts == {"mission": "leave the frame"}


def test_facts_of_arrays_are_kept(tmp_path):
    video, actions = np.zeros((4, 16, 16, 3), np.uint8), np.zeros((4, 1))
    recording = Recording(video, actions, facts={"task": "rest"})
    action = ActionSpec(("x",), ("m",), (-1,), (1,), "delta")
    write_dataset(tmp_path / "out", {"train": [recording]}, name="it", action=action, fps=10)
    assert EpisodeDataset(tmp_path / "out", "train").about(0)["facts"] == {"task": "rest"}
