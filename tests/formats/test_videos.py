"""A folder of videos: what is found in it, which column is what, and what is refused by name."""

import json
import pickle
from fractions import Fraction

import fsspec
import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data import remote
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_formats.sizes import small_size
from acwm_formats.videos import Videos
from tests.formats.corpus import tables
from tests.formats.corpus.cases import episode
from tests.formats.corpus.clips import Clip, write_clip, write_images
from tests.formats.corpus.pictures import number_in


def film(path, first, clip=None):
    """Write eight frames; returns what they show and the rows that belong to them."""
    path.parent.mkdir(parents=True, exist_ok=True)
    shown = episode(first)
    write_clip(path, shown.numbers, shown.times, 10, clip or Clip())
    return shown


def write(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def first_number(recording, camera):
    (frame,) = recording.cameras[camera].read([0])
    return number_in(frame)


def test_a_folder_per_episode_with_several_cameras(tmp_path):
    for place in (0, 1):
        shown = film(tmp_path / f"run {place}" / "top.mp4", 40 * place)
        film(tmp_path / f"run {place}" / "wrist.mp4", 40 * place + 20)
        write_images(tmp_path / f"run {place}" / "side", shown.numbers, "png")
        tables.write_csv(tmp_path / f"run {place}" / "log.csv", shown, "time")
    found = Videos().read(tmp_path)
    second = found.splits[1]
    assert second.name == "run 1"
    assert [*second.cameras] == ["side", "top", "wrist"]
    assert [first_number(second, name) for name in second.cameras] == [40, 40, 60]
    assert Videos.detect(tmp_path)


def test_a_folder_with_the_name_of_a_simulator_is_no_data_of_it(tmp_path):
    shown = film(tmp_path / "push_cube" / "a.mp4", 1)
    tables.write_csv(tmp_path / "push_cube" / "a.csv", shown, "time")
    assert Videos().read(tmp_path / "push_cube").name == "push_cube_recorded"


def test_two_cameras_behind_a_url_become_one_wide_frame(tmp_path, monkeypatch):
    monkeypatch.setenv(remote.CACHE, str(tmp_path / "cache"))
    for place in (0, 1):
        shown = film(tmp_path / f"runs/run {place}/top.mp4", 40 * place)
        film(tmp_path / f"runs/run {place}/wrist.mp4", 40 * place + 20)
        tables.write_csv(tmp_path / f"runs/run {place}/log.csv", shown, "time")
    memory = fsspec.filesystem("memory")
    memory.put(str(tmp_path / "runs"), "/runs", recursive=True)
    words = ["data", "import", "memory://runs", "--camera", "wrist", "--camera", "top"]
    words += ["--out", str(tmp_path / "out"), "--workers", "0", "--test-episodes", "0"]
    done = CliRunner().invoke(main, words)
    memory.rm("/runs", recursive=True)
    assert done.exit_code == 0, done.output
    assert "is in the format videos" in done.output
    assert DatasetCard.read(tmp_path / "out").environment.views == ("wrist", "top")
    frame = EpisodeDataset(tmp_path / "out", "train")[1].video[3]
    left, right = np.split(frame, 2, axis=1)
    assert (number_in(left), number_in(right)) == (63, 43)


def test_a_folder_that_another_command_filled_is_left_alone(tmp_path):
    for place in (0, 1, 2):
        tables.write_csv(
            tmp_path / f"takes/{place}.csv", film(tmp_path / f"takes/{place}.mp4", 0), "time"
        )
    words = ["data", "import", "videos", str(tmp_path / "takes"), "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(main, [*words, "--workers", "0"])
    assert done.exit_code == 0, done.output
    command = DatasetCard.read(tmp_path / "out").source["command"]
    assert "from-first-row" not in command
    again = CliRunner().invoke(main, [*words, "--workers", "0", "--test-episodes", "1"])
    assert again.exit_code == 2
    assert f"source.command is {command} there" in again.output
    assert "--test-episodes 1 now" in again.output


def test_the_advised_size_keeps_the_shape():
    assert small_size((64, 96)) == (64, 96)
    assert small_size((480, 640)) == (64, 88)
    assert small_size((1920, 1080)) == (112, 64)


def test_a_worker_gets_what_its_recordings_need(tmp_path):
    for name in "abc":
        film(tmp_path / f"{name}.mp4", 0)
        write(tmp_path / f"{name}.csv", CSV)
    part = pickle.loads(pickle.dumps(Videos().read(tmp_path).splits.part([1])))
    assert (len(part), part[1].name) == (3, "b")
    with pytest.raises(KeyError):
        part[0]


def test_columns_by_name(tmp_path):
    film(tmp_path / "a.mp4", 0)
    lines = [f"{k / 10},{k},{-k},x,{k % 2}" for k in range(8)]
    write(tmp_path / "a.csv", "\n".join(["time,push,turn,label,seen", *lines]))
    found = Videos().read(tmp_path, columns="turn", states="seen")
    recording = found.splits[0]
    np.testing.assert_array_equal(recording.actions.values[:, 0], -np.arange(8))
    np.testing.assert_allclose(recording.actions.times, np.arange(8) / 10)
    np.testing.assert_array_equal(recording.states["seen"].values[:, 0], np.arange(8) % 2)
    assert any("neither actions nor states: push." in note for note in found.notes)
    assert found.actions.names == ("turn",)
    assert recording.rate == 10


def test_a_state_has_all_columns_of_its_vector(tmp_path):
    film(tmp_path / "a.mp4", 1)
    rows = [f"{i},{i + 0.5},{-i},{10 * i}" for i in range(8)]
    write(tmp_path / "a.csv", "\n".join(["turn,block_x,block_y,block_size", *rows]))
    found = Videos().read(tmp_path, states="block,block_size")
    states = found.splits[0].states
    place = np.arange(8.0)
    np.testing.assert_array_equal(states["block"].values, np.stack([place + 0.5, -place], 1))
    np.testing.assert_array_equal(states["block_size"].values, 10 * place[:, None])
    assert found.actions.names == ("turn",)
    with pytest.raises(DataError, match="no column 'cube'"):
        Videos().read(tmp_path, states="cube")


def test_what_is_called_action_is_one(tmp_path):
    film(tmp_path / "a.mp4", 0)
    np.savez(tmp_path / "a.npz", action=np.ones((8, 3)), reward=np.zeros(8))
    assert Videos().read(tmp_path).actions.names == ("action_0", "action_1", "action_2")


@pytest.mark.parametrize("named", ["a", "a.mp4", 0], ids=["stem", "file", "number"])
def test_one_table_for_all(tmp_path, named):
    film(tmp_path / "a.mp4", 0)
    film(tmp_path / "b.mp4", 20)
    other = 1 if named == 0 else str(named).replace("a", "b")
    rows = [f"{who},{k}" for who in (other, named) for k in range(8)]
    write(tmp_path / "all.csv", "\n".join(["video,push", *rows]))
    recording = Videos().read(tmp_path).splits[0]
    np.testing.assert_array_equal(recording.actions.values[:, 0], np.arange(8))


def test_nanoseconds_keep_their_precision(tmp_path):
    film(tmp_path / "a.mp4", 0)
    start = 1_700_000_000_123_456_789
    rows = [f"{start + k * 100_000_000},{k}" for k in range(8)]
    write(tmp_path / "a.csv", "\n".join(["stamp_ns,push", *rows]))
    recording = Videos().read(tmp_path, from_first_row=True).splits[0]
    np.testing.assert_allclose(recording.actions.times, np.arange(8) / 10, atol=1e-6)


CSV = "time,push\n0,1\n0.1,2\n"
REFUSED = {
    "no table": ({"a.mp4": None}, {}, "has no table of actions beside a"),
    "no video": ({"a.csv": CSV}, {}, "holds no video"),
    "an unknown column": ({"a.mp4": None, "a.csv": CSV}, {"columns": "pusch"}, "mean 'push'"),
    "no action": ({"a.mp4": None, "a.csv": "time\n0\n"}, {}, "no column of actions"),
    "a decimal comma": ({"a.mp4": None, "a.csv": "push\tturn\n1,5\t2\n"}, {}, "holds '1,5'"),
    "no row": ({"a.mp4": None, "a.csv": "push\n"}, {}, "holds no row"),
    "several tables": (
        {"a.mp4": None, "x.csv": CSV, "y.csv": CSV},
        {},
        "several tables .x.csv, y.csv.: give --actions",
    ),
    "other episodes": (
        {"a.mp4": None, "all.csv": "episode,push\nb,1\n"},
        {},
        "no row of a in the column episode",
    ),
    "a number too many": (
        {"a.mp4": None, "all.csv": "episode,push\n0,1\n1,1\n"},
        {},
        "numbers 2 episodes from 0 to 1, but there are 1 videos",
    ),
}


@pytest.mark.parametrize(("files", "options", "problem"), REFUSED.values(), ids=REFUSED)
def test_what_is_refused(tmp_path, files, options, problem):
    for name, text in files.items():
        film(tmp_path / name, 0) if text is None else write(tmp_path / name, text)
    with pytest.raises(DataError, match=problem):
        Videos().read(tmp_path, **options).splits[0]


def test_pictures_need_a_rate(tmp_path):
    write_images(tmp_path / "a", range(8), "png")
    write(tmp_path / "a.csv", "\n".join(["push", *map(str, range(8))]))
    with pytest.raises(DataError, match="8 pictures: give --rate"):
        Videos().read(tmp_path).splits[0]
    times = Videos().read(tmp_path, rate=29.97).splits[0].cameras["video"].times
    np.testing.assert_allclose(times, np.arange(8) / float(Fraction(30000, 1001)))


def test_a_lone_table_is_told(tmp_path):
    film(tmp_path / "a.mp4", 0)
    write(tmp_path / "a.csv", CSV)
    write(tmp_path / "b.csv", CSV)
    assert "Tables without a video: b.csv." in Videos().read(tmp_path).notes


def timed(folder, head, row):
    """A film of 8 frames at 10 per second, and a table of times and of numbers from 0."""
    film(folder / "a.mp4", 0)
    write(folder / "a.csv", "\n".join([head, *map(row, range(8))]))
    return Videos().read(folder).splits[0].actions


@pytest.mark.parametrize(
    ("head", "unit"),
    [("Time [ms],x", 1e-3), ("timestamp (s),x", 1.0), ("t_sec,x", 1.0), ("TIME(us),x", 1e-6)],
)
def test_units_of_time_in_the_name_of_a_column(tmp_path, head, unit):
    found = timed(tmp_path, head, lambda k: f"{k * 0.1 / unit:.6f},{k}")
    assert found.values.tolist() == [[k] for k in range(8)]
    np.testing.assert_allclose(found.times, np.arange(8) / 10)


@pytest.mark.parametrize("first", [0, 1])
def test_times_that_number_the_frames_are_no_seconds(tmp_path, first):
    found = timed(tmp_path, "t,x", lambda k: f"{k + first},{k}")
    assert found.times is None


def test_a_number_of_rows_in_one_table_for_all_is_no_time(tmp_path):
    for place, name in enumerate("ab"):
        film(tmp_path / f"{name}.mp4", place)
    lines = [f"{'ab'[k // 8]},{k},{k}" for k in range(16)]
    write(tmp_path / "all.csv", "\n".join(["video,t,x", *lines]))
    found = Videos().read(tmp_path, from_first_row=True).splits
    assert [found[place].actions.times for place in (0, 1)] == [None, None]


def test_a_number_of_rows_that_lacks_some_is_refused(tmp_path):
    film(tmp_path / "a.mp4", 0)
    write(tmp_path / "a.csv", "\n".join(["t,x", *[f"{k},{k}" for k in range(6)]]))
    with pytest.raises(DataError, match="span 5 s, and the video"):
        Videos().read(tmp_path).splits[0]


@pytest.mark.parametrize("head", ["time,x", "t,x"])
def test_times_in_another_unit_are_refused(tmp_path, head):
    with pytest.raises(
        DataError, match=r"span 700 s, and the video 0\.7 s: in milliseconds or nano"
    ):
        timed(tmp_path, head, lambda k: f"{100 * k},{k}")


@pytest.mark.parametrize("row", ["{k} -{k}.5", "{k}|{k}", "{k}   {k}"])
def test_numbers_between_other_delimiters_are_refused(tmp_path, row):
    with pytest.raises(DataError, match="separated by neither commas, semicolons nor tabs"):
        timed(tmp_path, "x y", lambda k: row.format(k=k))


def test_thousands_are_no_text(tmp_path):
    with pytest.raises(DataError, match=r"'1,000\.5', which is not a number"):
        timed(tmp_path, "x,y", lambda k: f'{k},"1,00{k}.5"')


NESTED = [{"action": {"x": k, "arm": {"y": -k}}, "reward": 1, "task": "go"} for k in range(8)]


@pytest.mark.parametrize("ending", ["json", "jsonl", "parquet"])
def test_objects_in_rows_are_columns(tmp_path, ending):
    film(tmp_path / "a.mp4", 0)
    path = tmp_path / f"a.{ending}"
    if ending == "parquet":
        pyarrow.parquet.write_table(pyarrow.Table.from_pylist(NESTED), path)
    else:
        write(path, json.dumps(NESTED) if ending == "json" else "\n".join(map(json.dumps, NESTED)))
    found = Videos().read(tmp_path)
    assert found.actions.names == ("action.x", "action.arm.y")
    assert found.splits[0].actions.values.tolist() == [[k, -k] for k in range(8)]
    assert found.splits[0].facts == {"task": "go"}


@pytest.mark.parametrize(
    ("rows", "sentence"),
    [
        ([{"x": [1]}, {"x": [1, 2]}], "the rows of x have different lengths"),
        ([{"x": {"a": 1}}, {"x": {"b": 1}}], "the rows of x have different entries"),
        ({"x": [1, 2], "fps": 10}, "fps is 10, but a column has a value per row: leave it out"),
    ],
)
def test_rows_that_are_no_table(tmp_path, rows, sentence):
    film(tmp_path / "a.mp4", 0)
    write(tmp_path / "a.json", json.dumps(rows))
    with pytest.raises(DataError, match=sentence):
        Videos().read(tmp_path)
