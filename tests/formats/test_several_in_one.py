"""Several recordings in one file, table or folder are read as several, or refused."""

import h5py
import numpy as np
import pytest
import zarr

from acwm_core.errors import DataError
from acwm_formats.alignment import Alignment, align
from acwm_formats.episode_bounds import bounds_of
from acwm_formats.hdf5 import HDF5
from acwm_formats.videos import Videos, find_places
from acwm_formats.zarr_replay import ZarrReplay
from tests.formats.corpus.cases import at
from tests.formats.corpus.clips import Clip, write_clip, write_images
from tests.formats.corpus.pictures import number_in, picture

LENGTHS = (10, 12, 8, 9)
ENDS = np.cumsum(LENGTHS)
STARTS = ENDS - LENGTHS
COUNT = int(ENDS[-1])
NUMBERS = np.repeat(np.arange(4), LENGTHS)
LAST = np.isin(np.arange(COUNT), ENDS - 1)
FIRST = np.isin(np.arange(COUNT), STARTS)
ROWS = np.stack([np.arange(COUNT), np.arange(COUNT) % 3], 1).astype(np.float32)

SAYS = {
    "lengths and offsets": {"ep_len": LENGTHS, "ep_offset": STARTS},
    "lengths": {"episode_lengths": LENGTHS},
    "ends": {"episode_ends": ENDS},
    "last rows": {"traj_ends": ENDS - 1},
    "starts": {"episode_starts": STARTS},
    "a number": {"episode_index": NUMBERS},
    "a number that counts on": {"ep_idx": NUMBERS + 7},
    "a name": {"episode_id": np.array([b"a", b"b", b"c", b"d"])[NUMBERS]},
    "terminals": {"terminals": LAST},
    "timeouts too": {"terminals": LAST & (NUMBERS % 2 == 0), "timeouts": LAST & (NUMBERS % 2 == 1)},
    "first rows": {"is_first": FIRST},
    "pairs": {"episode_bounds": np.stack([STARTS, ENDS], 1)},
    "limits": {"episode_boundaries": np.append(0, ENDS)},
    "counters": {"step_idx": np.arange(COUNT) - STARTS[NUMBERS]},
    "lengths of another name": {"n_steps": LENGTHS},
    "ends of another name": {"cumulative": ENDS},
    "flags of what goes on": {"discount": 1.0 - LAST},
    "resets": {"reset": FIRST},
    "kinds of steps": {"step_type": np.where(FIRST, 0, 1 + LAST)},
    "a scene": {"scene_id": NUMBERS},
    "counters beside flags that are never set": {
        "terminals": np.zeros(COUNT, bool),
        "step": np.arange(COUNT) - STARTS[NUMBERS],
    },
}


def frames():
    return np.stack([picture(number, (32, 48)) for number in range(COUNT)])


def file_of(path, says, *, group="/", beside="/"):
    with h5py.File(path, "w") as file:
        file.require_group(group)["pixels"] = frames()
        file[group]["action"] = ROWS
        file[group]["proprio"] = ROWS[:, :1]
        for name, values in says.items():
            file.require_group(beside)[name] = values
    return path


def are_the_four(recordings):
    assert len(recordings) == 4
    for index, (start, stop) in enumerate(zip(STARTS, ENDS, strict=True)):
        recording = recordings[index]
        np.testing.assert_array_equal(recording.actions.values, ROWS[start:stop])
        (seen, *_) = recording.cameras.values()
        assert len(seen.times) == stop - start
        ends = [0, stop - start - 1]
        assert [int(number_in(f)) for f in seen.read(ends)] == [start, stop - 1]
    return True


@pytest.mark.parametrize("says", SAYS.values(), ids=SAYS)
@pytest.mark.parametrize(("group", "beside"), [("/", "/"), ("/", "meta"), ("data", "meta")])
def test_arrays_of_all_episodes_in_hdf5(tmp_path, says, group, beside):
    path = file_of(tmp_path / "all.h5", says, group=group, beside=beside)
    found = HDF5().read(path, video="pixels", actions="action", rate=10)
    assert are_the_four(found.splits)


def test_files_of_stable_worldmodel_are_known(tmp_path):
    path = file_of(tmp_path / "pusht.h5", SAYS["lengths and offsets"])
    assert HDF5.detect(path)
    with pytest.raises(DataError, match="give --rate"):
        HDF5().read(path)
    found = HDF5().read(path, rate=10)
    assert found.facts["layout"] == "stable-worldmodel"
    assert are_the_four(found.splits)
    assert [*found.splits[1].states] == ["proprio"]
    assert found.splits[2].name == "pusht.h5 episode 2"


def test_the_row_after_the_last_action_may_be_empty(tmp_path):
    """Its last action leads to no frame, and is stored as NaN."""
    path = file_of(tmp_path / "all.h5", SAYS["lengths"])
    with h5py.File(path, "a") as file:
        for end in ENDS:
            file["action"][end - 1] = np.nan
    recording = HDF5().read(path, rate=10).splits[0]
    found = align(recording, ["pixels"], Alignment())
    assert found.defects == []
    np.testing.assert_array_equal(found.episodes[0].actions[:-1], ROWS[:9])


WRONG = {
    "too few": {"ep_len": (10, 12, 8, 8)},
    "too many": {"ep_len": LENGTHS, "ep_offset": STARTS + 1},
    "one over another": {"ep_len": LENGTHS, "ep_offset": (0, 9, 22, 30)},
    "apart": {"episode_index": np.where(np.arange(COUNT) == 38, 0, NUMBERS)},
}


CONTRARY = {
    "numbers": ({"episode_ends": ENDS}, {"episode_index": NUMBERS >= 2}),
    "lengths": ({"episode_ends": ENDS}, {"ep_len": (20, 19)}),
    "a first row": ({"episode_ends": ENDS}, {"is_first": np.arange(COUNT) % 13 == 0}),
    "steps": ({"ep_len": LENGTHS}, {"frame_index": np.arange(COUNT) % 13}),
    "times": ({"episode_ends": ENDS}, {"timestamp": np.arange(COUNT) % 13 / 10}),
    "two numbers": ({"episode_index": NUMBERS}, {"traj_id": NUMBERS >= 2}),
    "one episode": ({"episode_ends": [COUNT]}, {"episode_index": NUMBERS}),
}


@pytest.mark.parametrize(("one", "other"), CONTRARY.values(), ids=CONTRARY)
def test_arrays_that_contradict_each_other_are_refused(tmp_path, one, other):
    """Beside each other, in two groups, in Zarr and in a table."""
    says = {name: np.asarray(values) for name, values in {**one, **other}.items()}
    with pytest.raises(DataError, match=r"it contradicts itself: by \w+, episodes begin in"):
        bounds_of(says, COUNT, "it")
    path = file_of(tmp_path / "all.h5", one, beside="meta")
    group = zarr.open_group(str(tmp_path / "b.zarr"), mode="w", zarr_format=2)
    arrays = {"data/img": frames(), "data/action": ROWS}
    arrays |= {f"meta/{name}": np.asarray(values) for name, values in one.items()}
    with h5py.File(path, "a") as file:
        for name, values in other.items():
            file[name] = arrays[f"data/{name}"] = np.asarray(values)
    for name, values in arrays.items():
        group.create_array(name, data=values)
    with pytest.raises(DataError, match="contradicts itself"):
        HDF5().read(path, video="pixels", actions="action", rate=10).splits[0]
    with pytest.raises(DataError, match="contradicts itself"):
        ZarrReplay().read(tmp_path / "b.zarr", rate=10)


def test_arrays_that_say_the_same_may_stand_beside_each_other():
    """Flags of last rows may be set within an episode, and lengths be in another order."""
    says = {"episode_ends": ENDS, "episode_index": NUMBERS, "ep_len": LENGTHS, "ep_offset": STARTS}
    says |= {"timestamp": np.arange(COUNT) - STARTS[NUMBERS], "done": np.arange(COUNT) % 5 == 0}
    says |= {"id": np.arange(COUNT) // 3, "stage_time": np.arange(COUNT) % 4}
    edges = list(zip(STARTS.tolist(), ENDS.tolist(), strict=True))
    arrays = {name: np.asarray(values) for name, values in says.items()}
    assert bounds_of(arrays, COUNT, "it") == edges
    order = [2, 0, 3, 1]
    turned = {"ep_len": np.array(LENGTHS)[order], "ep_offset": STARTS[order], "episode": NUMBERS}
    assert sorted(bounds_of(turned, COUNT, "it") or []) == edges


@pytest.mark.parametrize("says", WRONG.values(), ids=WRONG)
def test_what_contradicts_itself_is_refused(tmp_path, says):
    path = file_of(tmp_path / "all.h5", says)
    with pytest.raises(DataError, match="episode"):
        HDF5().read(path, video="pixels", actions="action", rate=10).splits[0]


def test_one_file_that_contradicts_itself_is_a_defect(tmp_path):
    file_of(tmp_path / "a.h5", SAYS["lengths"])
    file_of(tmp_path / "b.h5", WRONG["too few"])
    recordings = HDF5().read(tmp_path, rate=10).splits
    assert len(recordings) == 5
    with pytest.raises(DataError, match="have 38 rows, and it has 39"):
        recordings[4]


def test_demonstrations_that_end_more_than_once_are_one_each(tmp_path):
    """Where every episode has a group, flags do not divide it."""
    with h5py.File(tmp_path / "mine.h5", "w") as file:
        for run in "ab":
            file[f"{run}/pixels"], file[f"{run}/action"] = frames(), ROWS
            file[f"{run}/dones"] = LAST
    found = HDF5().read(tmp_path / "mine.h5", video="pixels", actions="action", rate=10)
    assert len(found.splits) == 2


@pytest.mark.parametrize(
    "says", [{"": None}, {"x": np.arange(COUNT)}, {"ep_len": [COUNT]}, {"episode": NUMBERS * 0}]
)
def test_one_recording_stays_one(says):
    arrays = {name: np.asarray(values) for name, values in says.items() if name}
    assert bounds_of(arrays, COUNT, "it") is None


@pytest.mark.parametrize("place", ["meta/episode_ends", "data/episode_ends", "episode_ends"])
def test_a_buffer_says_its_ends_in_several_places(tmp_path, place):
    group = zarr.open_group(str(tmp_path / "b.zarr"), mode="w", zarr_format=2)
    group.create_array("data/img", data=frames())
    group.create_array("data/action", data=ROWS)
    group.create_array(place, data=ENDS)
    assert ZarrReplay.detect(tmp_path / "b.zarr")
    assert are_the_four(ZarrReplay().read(tmp_path / "b.zarr", rate=10).splits)


@pytest.mark.parametrize("place", ["data/episode_index", "meta/ep_idx"])
def test_a_buffer_may_number_rows(tmp_path, place):
    group = zarr.open_group(str(tmp_path / "b.zarr"), mode="w", zarr_format=2)
    group.create_array("data/img", data=frames())
    group.create_array("data/action", data=ROWS)
    group.create_array(place, data=NUMBERS)
    assert ZarrReplay.detect(tmp_path / "b.zarr")
    assert are_the_four(ZarrReplay().read(tmp_path / "b.zarr", rate=10).splits)


ELSEWHERE = {
    "a group of another name": {"info/n_steps": LENGTHS},
    "ends there": {"labels/cumulative": ENDS},
    "pairs of another name": {"spans": np.stack([STARTS, ENDS], 1)},
    "pairs with the last row": {"spans": np.stack([STARTS, ENDS - 1], 1)},
    "a column": {"n_steps": np.array(LENGTHS)[:, None]},
    "limits of another name": {"cuts": np.append(0, ENDS)},
}


@pytest.mark.parametrize("says", ELSEWHERE.values(), ids=ELSEWHERE)
def test_episodes_by_arrays_that_no_layout_names(tmp_path, says):
    path = file_of(tmp_path / "all.h5", says)
    assert are_the_four(HDF5().read(path, video="pixels", actions="action", rate=10).splits)
    group = zarr.open_group(str(tmp_path / "b.zarr"), mode="w", zarr_format=2)
    for name, values in {"data/img": frames(), "data/action": ROWS, **says}.items():
        group.create_array(name, data=np.asarray(values))
    assert are_the_four(ZarrReplay().read(tmp_path / "b.zarr", rate=10).splits)


@pytest.mark.parametrize("name", ["ep_len", "horizons"])
def test_episodes_by_attributes(tmp_path, name):
    path = file_of(tmp_path / "all.h5", {})
    with h5py.File(path, "a") as file:
        file.attrs[name] = LENGTHS
    assert are_the_four(HDF5().read(path, video="pixels", actions="action", rate=10).splits)


def test_a_buffer_that_says_no_ends_is_refused(tmp_path):
    group = zarr.open_group(str(tmp_path / "b.zarr"), mode="w", zarr_format=2)
    for name, values in {"data/img": frames(), "data/action": ROWS}.items():
        group.create_array(name, data=values)
    with pytest.raises(DataError, match="says where episodes end: store meta/episode_ends"):
        ZarrReplay().read(tmp_path / "b.zarr", rate=10)


def test_arrays_of_five_axes_are_refused_by_what_they_are(tmp_path):
    seen, acted = frames()[:36].reshape(3, 12, 32, 48, 3), ROWS[:36].reshape(3, 12, 2)
    why = "stacks whole episodes, or several cameras, as its frames are"
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["pixels"], file["action"] = seen, acted
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["data/demo_0/obs/top"], file["data/demo_0/actions"] = seen, acted
    with pytest.raises(DataError, match=why):
        HDF5().read(tmp_path / "b.h5", rate=10)
    recording = HDF5().read(tmp_path / "a.h5", video="pixels", actions="action", rate=10).splits[0]
    with pytest.raises(DataError, match=why):
        next(iter(recording.cameras["pixels"].read([0])))
    group = zarr.open_group(str(tmp_path / "b.zarr"), mode="w", zarr_format=2)
    for name, values in {"data/img": seen, "data/action": acted, "meta/ep_len": [12] * 3}.items():
        group.create_array(name, data=np.asarray(values))
    with pytest.raises(DataError, match=why):
        ZarrReplay().read(tmp_path / "b.zarr", rate=10)


def test_an_index_of_episodes_in_a_group(tmp_path):
    says = {"from": STARTS, "to": ENDS}
    path = file_of(tmp_path / "all.h5", says, beside="episode_data_index")
    found = HDF5().read(path, video="pixels", actions="action", rate=10)
    assert are_the_four(found.splits)


def test_a_buffer_may_say_lengths(tmp_path):
    group = zarr.open_group(str(tmp_path / "b.zarr"), mode="w", zarr_format=2)
    group.create_array("data/img", data=frames())
    group.create_array("data/action", data=ROWS)
    group.create_array("meta/episode_lengths", data=np.array(LENGTHS))
    assert are_the_four(ZarrReplay().read(tmp_path / "b.zarr", rate=10).splits)


NAMES = {
    "of stable-worldmodel": "ep_{e}_step_{s}.png",
    "with zeros": "episode_{e:03d}_frame_{s:06d}.png",
    "two numbers": "{e}_{s}.png",
    "from one": "traj{e1}-{s1}.png",
    "a number that goes on": "Take {e} {k:04d}.png",
}


def pictured(folder, pattern):
    write_images(folder, range(COUNT), "png")
    for place, path in enumerate(
        sorted(folder.iterdir(), key=lambda p: int(p.stem.split("_")[-1]))
    ):
        e = int(NUMBERS[place])
        s = int(place - STARTS[e])
        path.rename(folder / f"x{pattern.format(e=e, s=s, e1=e + 1, s1=s + 1, k=place)}")
    for path in [*folder.iterdir()]:
        path.rename(folder / path.name.removeprefix("x"))


@pytest.mark.parametrize("pattern", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize("says", [{}, {"ep_len": LENGTHS, "ep_offset": STARTS}])
@pytest.mark.parametrize("table", ["all.npz", "pixels/all.npz", "pixels.npz"])
def test_pictures_of_several_episodes_in_one_folder(tmp_path, pattern, says, table):
    pictured(tmp_path / "pixels", pattern)
    np.savez(tmp_path / table, action=ROWS, **says)
    found = Videos().read(tmp_path, rate=10)
    assert are_the_four(found.splits)
    assert any("4 episodes" in note for note in found.notes)


EPISODE_LAST = {
    "two numbers": "{s}_{e}.png",
    "words": "frame_{s}_ep_{e}.png",
    "a word for frames": "frame{s:04d}_{e1}.png",
    "a word for episodes": "{s1:03d}-episode{e}.png",
}


@pytest.mark.parametrize("pattern", EPISODE_LAST.values(), ids=EPISODE_LAST)
def test_pictures_whose_episode_comes_last(tmp_path, pattern):
    pictured(tmp_path / "pixels", pattern)
    np.savez(tmp_path / "all.npz", action=ROWS)
    assert are_the_four(Videos().read(tmp_path, rate=10).splits)


def named(folder, names):
    folder.mkdir()
    for name in names:
        (folder / name).write_bytes(b"")
    (folder / "a.csv").write_text("x\n" + "1\n" * len(names))


EQUAL = [(e, s) for e in range(3) for s in range(5)]
GAPS = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (1, 3), (2, 0), (2, 1)]


@pytest.mark.parametrize(
    ("pattern", "numbers", "why"),
    [
        ("{0}_{1}.png", EQUAL, "either number may be"),
        ("{1}_{0}.png", EQUAL, "either number may be"),
        ("img_{0}_{1}.png", EQUAL, "either number may be"),
        ("ep_{0}_step_{1}.png", GAPS, "not numbered one by one"),
        ("step_{1}_ep_{0}.png", GAPS, "not numbered one by one"),
        ("{0}_{1}.png", GAPS, "not numbered one by one"),
        ("{1}_{0}.png", GAPS, "not numbered one by one"),
        ("{0}_{1}0.png", EQUAL, "not numbered one by one"),
        ("step_{1}_cam_{0}.png", EQUAL, "several cameras"),
    ],
)
def test_several_recordings_that_cannot_be_told_apart_are_refused(tmp_path, pattern, numbers, why):
    named(tmp_path / "a", [pattern.format(*pair) for pair in numbers])
    with pytest.raises(DataError, match=why):
        find_places(tmp_path)


def test_a_picture_beside_those_of_several_recordings_is_refused(tmp_path):
    named(tmp_path / "a", ["cover.png", *(f"ep{e}_{s}.png" for e, s in EQUAL)])
    with pytest.raises(DataError, match=r"and cover\.png: remove it"):
        find_places(tmp_path)


@pytest.mark.parametrize(
    ("pattern", "count"),
    [
        *[(name, 3) for name in ("ep_{0}_step_{1}.png", "{0}_frame{1}.png", "frame{1}_{0}.png")],
        *[(name, 1) for name in ("0_{2}.png", "{2}_0.png", "f{2:04d}_640x480.png")],
        *[(name, 1) for name in ("2024-01-05_12-0{0}-0{1}.png", "170000000{0}_{1}.png")],
    ],
)
def test_words_and_times_in_names_of_pictures(tmp_path, pattern, count):
    named(tmp_path / "a", [pattern.format(e, s, 5 * e + s) for e, s in EQUAL])
    assert len(find_places(tmp_path)) == count


def test_pictures_whose_rows_are_of_another_number_are_refused(tmp_path):
    pictured(tmp_path / "pixels", NAMES["two numbers"])
    np.savez(tmp_path / "all.npz", action=ROWS[:-1])
    with pytest.raises(DataError, match="38 rows, but its episodes have 39 pictures"):
        Videos().read(tmp_path, rate=10).splits[0]


def test_pictures_by_time_or_camera_are_no_episodes(tmp_path):
    folder = tmp_path / "a"
    write_images(folder, range(6), "png")
    for place, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"{1700000000 + place // 2}_{place * 499 % 1000}.png")
    (tmp_path / "a.csv").write_text("x\n" + "\n".join("123456"))
    assert len(Videos().read(tmp_path, rate=10).splits) == 1
    for place, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"s{place // 2}_{place}.png")
    assert len(Videos().read(tmp_path, rate=10).splits) == 1
    for place, path in enumerate(sorted(folder.iterdir())):
        path.rename(folder / f"cam{place % 2}_{place // 2}.png")
    with pytest.raises(DataError, match="several cameras"):
        Videos().read(tmp_path, rate=10)


@pytest.mark.parametrize("column", ["episode_index", "episode", "ep", "traj_id"])
def test_one_video_of_several_episodes_is_refused(tmp_path, column):
    write_clip(tmp_path / "a.mp4", range(6), at(*range(6)), 10, Clip())
    (tmp_path / "a.csv").write_text(f"{column},x\n0,1\n0,2\n0,3\n1,4\n1,5\n1,6\n")
    with pytest.raises(DataError, match=f"column {column} .* numbers 2 episodes"):
        Videos().read(tmp_path).splits[0]


@pytest.mark.parametrize(
    ("column", "several"),
    [
        ({"done": [0, 0, 1, 0, 0, 1]}, True),
        ({"is_first": [1, 0, 0, 1, 0, 0]}, True),
        ({"step": [0, 1, 2, 0, 1, 2]}, True),
        ({"time": [0, 0.1, 0.2, 0, 0.1, 0.2]}, True),
        ({"time_ms": [70, 170, 270, 72, 172, 272]}, True),
        ({"sim_time": [0, 1, 2, 0, 1, 2]}, True),
        ({"done": [0, 0, 0, 0, 1, 1]}, False),
        ({"step": [0, 1, 2, 3, 4, 5]}, False),
    ],
)
def test_a_table_that_ends_more_than_once_is_refused(tmp_path, column, several):
    ((name, values),) = column.items()
    write_clip(tmp_path / "a.mp4", range(6), at(*range(6)), 10, Clip())
    rows = "".join(f"{value},{index}\n" for index, value in enumerate(values))
    (tmp_path / "a.csv").write_text(f"{name},action\n{rows}")
    found = Videos().read(tmp_path).splits
    if not several:
        np.testing.assert_array_equal(found[0].actions.values[:, 0], range(6))
        return
    with pytest.raises(DataError, match=r"has 2 episodes, by .*, but a is one"):
        found[0]


def test_times_that_begin_anew_tell_episodes_apart(tmp_path):
    times = 5.0 + 0.1 * (np.arange(COUNT) - STARTS[NUMBERS])
    path = file_of(tmp_path / "all.h5", {"timestamp": times})
    assert are_the_four(HDF5().read(path, video="pixels", actions="action", rate=10).splits)


@pytest.mark.parametrize(
    "other",
    [
        {"keyframes": [0, 10, 25]},
        {"limits": [1, 2, 3]},
        {"stage": NUMBERS},
        {"mask": ROWS[:, 1]},
        {"t": np.arange(COUNT)},
    ],
)
def test_other_numbers_tell_no_episodes(other):
    arrays = {name: np.asarray(values) for name, values in other.items()}
    assert bounds_of(arrays, COUNT, "it") is None
