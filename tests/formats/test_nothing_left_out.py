"""Every source file, column and array is used or named."""

import json

import h5py
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
import zarr
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import DataError
from acwm_formats.arrays import Recording, write_dataset
from acwm_formats.hdf5 import HDF5
from acwm_formats.reading import divided
from acwm_formats.survey.survey import survey
from acwm_formats.timeline import RecordedDataset
from acwm_formats.videos import Videos
from acwm_formats.zarr_replay import ZarrReplay
from tests.formats.corpus import arrays, tables
from tests.formats.corpus.cases import Case, three
from tests.formats.test_videos import film, write

PLAIN = Case("plain", three(rate=20), rate=20)


def test_other_arrays_of_actions_are_named(tmp_path):
    path, _ = arrays.robomimic(tmp_path, PLAIN)
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            demo["action.gripper"] = np.zeros(len(demo["actions"]))
    assert any("action.gripper" in note for note in HDF5().read(path).notes)
    path, options = arrays.replay(tmp_path, PLAIN)
    group = zarr.open_group(str(path), mode="a")
    group.create_array("data/action.gripper", data=np.zeros(27, np.float32))
    group.create_array("data/obs/depth", data=np.zeros((27, 2), np.float32))
    notes = ZarrReplay().read(path, **options).notes
    assert "Arrays that were left out: action.gripper, obs/." in notes


def test_demonstrations_without_a_camera_are_defects(tmp_path):
    path, _ = arrays.robomimic(tmp_path, PLAIN)
    with h5py.File(path, "a") as file:
        del file["data/demo_1/obs/agentview_image"]
    found = HDF5().read(path).splits
    assert len(found) == 3
    with pytest.raises(DataError, match="no array /data/demo_1/obs/agentview_image"):
        found[1]


def test_groups_and_files_that_are_no_recordings_are_named(tmp_path):
    path, options = arrays.mapped(tmp_path, PLAIN)
    with h5py.File(path, "a") as file:
        del file["runs/1/obs/front"]
    (tmp_path / "more").mkdir()
    found = HDF5().read(tmp_path, **options)
    assert len(found.splits) == 2
    assert any("Groups of mine.h5 without cmd and obs/front: runs/1." in n for n in found.notes)
    assert "Files that were not read: more." in found.notes


def test_columns_of_actions_are_used_together(tmp_path):
    film(tmp_path / "a.mp4", 0)
    lines = [f"{k},{-k},{k % 2}" for k in range(8)]
    write(tmp_path / "a.csv", "\n".join(["action,action.gripper,reward", *lines]))
    found = Videos().read(tmp_path)
    assert found.actions.names == ("action", "action.gripper")
    assert any("reward" in note for note in found.notes)


def test_a_recording_with_two_tables_is_named(tmp_path):
    for name in "abc":
        shown = film(tmp_path / name / "top.mp4", 0)
        tables.write_csv(tmp_path / name / "log.csv", shown, "time")
    tables.write_csv(tmp_path / "b" / "more.csv", shown, "time")
    found = Videos().read(tmp_path).splits
    assert len(found) == 3
    with pytest.raises(DataError, match=r"b has several tables \(log.csv, more.csv\)"):
        found[1]
    assert len(Videos().read(tmp_path, actions="log.csv").splits[1].actions.values) == 8


def test_a_video_with_two_tables_is_named(tmp_path):
    shown = film(tmp_path / "a.mp4", 0)
    tables.write_csv(tmp_path / "a.csv", shown, "time")
    film(tmp_path / "b.mp4", 0)
    tables.write_csv(tmp_path / "b.csv", shown, "time")
    tables.write_npz(tmp_path / "b.npz", shown, "time")
    with pytest.raises(DataError, match=r"b has several tables \(b.csv, b.npz\)"):
        Videos().read(tmp_path).splits[1]


def parquet(path, names):
    table = pyarrow.Table.from_arrays([pyarrow.array([1.0, 2.0])] * len(names), names=names)
    pyarrow.parquet.write_table(table, path)


TWICE = {
    "csv": lambda p: write(p / "a.csv", "x,y,x\n1,2,3\n4,5,6\n"),
    "tsv": lambda p: write(p / "a.tsv", "x\tx\n1\t2\n"),
    "parquet": lambda p: parquet(p / "a.parquet", ["x", "x"]),
    "json": lambda p: write(p / "a.json", '{"x": [1, 2], "x": [3, 4]}'),
    "jsonl": lambda p: write(p / "a.jsonl", '{"x": 1, "x": 2}\n{"x": 1, "x": 2}'),
    "a vector": lambda p: np.savez(p / "a.npz", x=np.zeros((2, 2)), x_0=np.zeros(2)),
}


@pytest.mark.parametrize("spoil", TWICE.values(), ids=TWICE)
def test_two_columns_of_one_name_are_refused(tmp_path, spoil):
    film(tmp_path / "a.mp4", 0)
    spoil(tmp_path)
    with pytest.raises(DataError, match="two columns called x"):
        Videos().read(tmp_path)


@pytest.mark.parametrize(
    "text",
    [
        "0.1,0.5\n0.2,0.6\n",
        "0;1,5\n1;2,5\n",
        "0\t1\n1\t2\n",
        "1\n2\n",
        "push,0.5,1\npush,0.6,2\n",
        '"0","1"\n1,2\n',
        "nan,1\n1,2\n",
    ],
)
def test_a_first_row_of_numbers_is_no_header(tmp_path, text):
    film(tmp_path / "a.mp4", 0)
    write(tmp_path / "a.csv", text)
    with pytest.raises(DataError, match="first line holds numbers"):
        Videos().read(tmp_path)


def test_a_column_without_a_name_counts_rows_or_is_refused(tmp_path):
    film(tmp_path / "a.mp4", 0)
    write(tmp_path / "a.csv", "\n".join([",x", *(f"{k},{k / 8}" for k in range(8))]))
    assert Videos().read(tmp_path).actions.names == ("x",)
    write(tmp_path / "a.csv", "\n".join([",x", *(f"{k / 8},{k / 8}" for k in range(8))]))
    with pytest.raises(DataError, match="column without a name"):
        Videos().read(tmp_path)


def test_other_files_and_rows_are_named(tmp_path):
    film(tmp_path / "a.mp4", 0)
    rows = [f"{who},{k}" for who in "ac" for k in range(8)]
    write(tmp_path / "all.csv", "\n".join(["video,push", *rows]))
    write(tmp_path / "calibration.yaml", "x: 1")
    (tmp_path / "empty").mkdir()
    notes = " ".join(Videos().read(tmp_path).notes)
    assert "Files that were not read: calibration.yaml, empty." in notes
    assert "Rows without a video: c." in notes


@pytest.mark.parametrize(
    ("count", "tests"), [(2, 0), (3, 2), (9, 2), (10, 5), (35, 5), (49, 5), (60, 6), (200, 20)]
)
def test_five_test_episodes_where_there_are_enough(count, tests):
    parts = divided(RecordedDataset("x", [None] * count, {"name": "x"}), None)
    assert len(parts.get("ind_test", ((), ()))[1]) == tests


def test_choices_and_few_test_episodes_are_remarked(tmp_path):
    rng = np.random.default_rng(0)

    def made():
        video = rng.integers(0, 256, (20, 32, 32, 3), dtype=np.uint8)
        actions = np.stack([rng.integers(0, 4, 19), rng.uniform(0, 3, 19)], 1)
        return Recording(video, actions.astype(np.float32))

    action = ActionSpec(("button", "push"), ("", ""), (0, 0), (3, 3), "absolute")
    splits = {"train": [made() for _ in range(6)], "ind_test": [made() for _ in range(2)]}
    write_dataset(tmp_path, splits, name="it", action=action, fps=10, progress=False)
    said = " | ".join(each.text for each in survey(tmp_path).findings)
    assert "button takes the 4 whole numbers from 0 to 3" in said
    assert "push takes" not in said
    assert "ind_test has 2 episodes: an interval and a verdict need 5" in said


def settings(kind):
    return json.dumps({"env_name": "Lift", "type": 1, "env_kwargs": {"control_freq": 20, **kind}})


ARM = {"type": "OSC_POSE", "gripper": {"type": "GRIP"}}
KINDS = {
    "1.5 delta": ({"body_parts": {"right": {**ARM, "input_type": "delta"}}}, "delta"),
    "1.5 absolute": ({"body_parts": {"right": {**ARM, "input_type": "absolute"}}}, "absolute"),
    "1.5 nothing": ({"body_parts": {"right": ARM}}, "delta"),
    "1.5 nested": ({"body_parts": {"arms": {"right": ARM, "left": ARM}}}, "delta"),
    "1.5 still base": ({"body_parts": {"right": ARM, "torso": {"type": "JOINT_TORQUE"}}}, "delta"),
    "1.5 mixed": (
        {"body_parts": {"right": ARM, "left": {**ARM, "input_type": "absolute"}}},
        None,
    ),
    "1.4 delta": ({"type": "OSC_POSE", "control_delta": True}, "delta"),
    "1.4 absolute": ({"type": "OSC_POSE", "control_delta": False}, "absolute"),
    "1.4 nothing": ({"type": "OSC_POSITION"}, "delta"),
    "joints": ({"type": "JOINT_POSITION"}, "delta"),
    "speeds": ({"type": "JOINT_VELOCITY"}, "velocity"),
    "forces": ({"type": "JOINT_TORQUE"}, "torque"),
    "two arms": ([{"type": "IK_POSE"}, {"type": "OSC_POSE"}], "delta"),
    "another": ({"type": "MY_OWN"}, None),
}


@pytest.mark.parametrize(("config", "kind"), KINDS.values(), ids=KINDS)
def test_robosuite_says_what_actions_command(tmp_path, config, kind):
    path, _ = arrays.robomimic(tmp_path, PLAIN)
    with h5py.File(path, "a") as file:
        file["data"].attrs["env_args"] = settings({"controller_configs": config})
    found = HDF5().read(path)
    assert found.actions.kind == kind
    assert found.splits[0].rate == 20


def test_robosuite_without_controllers_takes_steps(tmp_path):
    path, _ = arrays.robomimic(tmp_path, PLAIN)
    with h5py.File(path, "a") as file:
        file["data"].attrs["env_args"] = settings({"robots": "Panda"})
    assert HDF5().read(path).actions.kind == "delta"


def test_steps_are_summed_and_unknown_ones_asked_about(tmp_path):
    parts = {"body_parts": {"right": ARM}}
    path, words = _of_controller(tmp_path / "known", parts)
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 0, done.output
    actions = EpisodeDataset(words[-1], "train").actions(0)
    with h5py.File(path) as file:
        total = file["data/demo_0/actions"][:8].reshape(4, 2, 2).sum(1)[:3]
    np.testing.assert_allclose(actions[:-1], total, atol=1e-5)
    _, words = _of_controller(tmp_path / "other", {"type": "MY_OWN"})
    done = CliRunner().invoke(main, words)
    assert done.exit_code == 2
    assert "give --action-kind" in done.stderr
    words[-1] = str(tmp_path / "stated")
    assert CliRunner().invoke(main, [*words, "--action-kind", "velocity"]).exit_code == 0


def _of_controller(folder, config):
    """A file of robomimic with such a controller, and the words to import half its frames."""
    folder.mkdir()
    path, _ = arrays.robomimic(folder, PLAIN)
    with h5py.File(path, "a") as file:
        file["data"].attrs["env_args"] = settings({"controller_configs": config})
    words = ["data", "import", "hdf5", str(path), "--fps", "10", "--workers", "0"]
    return path, [*words, "--test-episodes", "0", "--out", str(folder / "out")]


def test_a_gripper_is_held_and_not_summed(tmp_path):
    path = tmp_path / "demo.hdf5"
    rng = np.random.default_rng(0)
    rows = np.concatenate([rng.uniform(-1, 1, (9, 6)), rng.choice([-1.0, 1.0], (9, 1))], 1)
    with h5py.File(path, "w") as file:
        parts = {"body_parts": {"right": ARM}}
        file.create_group("data").attrs["env_args"] = settings({"controller_configs": parts})
        for place in range(3):
            file[f"data/demo_{place}/obs/top"] = arrays.images(PLAIN, PLAIN.episodes[1])
            file[f"data/demo_{place}/actions"] = rows
    words = ["data", "import", "hdf5", str(path), "--fps", "10", "--workers", "0"]
    done = CliRunner().invoke(main, [*words, "--out", str(tmp_path / "out")])
    assert done.exit_code == 0, done.output
    assert "held, averaged or summed" in done.output
    actions = EpisodeDataset(tmp_path / "out", "train").actions(0)[:-1]
    np.testing.assert_allclose(actions[:, :6], rows[:8:2, :6] + rows[1:8:2, :6], atol=1e-5)
    np.testing.assert_allclose(actions[:, 6], rows[:8:2, 6])


def test_absolute_actions_beside_steps_are_absolute(tmp_path):
    path, _ = arrays.robomimic(tmp_path, PLAIN)
    with h5py.File(path, "a") as file:
        for demo in file["data"].values():
            demo["actions_abs"] = demo["actions"][()]
    assert HDF5().read(path, actions="actions_abs").actions.kind == "absolute"
