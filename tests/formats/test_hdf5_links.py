"""HDF5 files that refer to others: within the recordings, elsewhere, through each other."""

import os
import pickle

import h5py
import numpy as np
import pytest

from acwm_core.errors import DataError
from acwm_formats import hdf5_store
from acwm_formats.hdf5 import HDF5
from acwm_formats.hdf5_layouts import open_hdf5
from acwm_formats.minari_datasets import Minari
from tests.formats.corpus import arrays
from tests.formats.test_hostile_sources import PLAIN, minari, refused, run

CAMERA = "observations/images/cam_high"


def moved(path, name, away):
    """Move an array out of a file, into another file; returns its shape and type."""
    with h5py.File(path, "a") as file, h5py.File(away, "a") as other:
        values = file[name][()]
        del file[name]
        other["there"] = values
    return values.shape, values.dtype


def a_link(path, name, away):
    moved(path, name, away)
    with h5py.File(path, "a") as file:
        file[name] = h5py.ExternalLink(str(away), "/there")


def a_relative_link(path, name, away):
    moved(path, name, away)
    with h5py.File(path, "a") as file:
        file[name] = h5py.ExternalLink(os.path.relpath(away, path.parent), "/there")


def a_soft_link_over_a_link(path, name, away):
    moved(path, name, away)
    with h5py.File(path, "a") as file:
        file["elsewhere"] = h5py.ExternalLink(str(away), "/")
        file[name] = h5py.SoftLink("/elsewhere/there")


def two_links(path, name, away):
    """Through a file in the folder, which links on."""
    moved(path, name, away)
    with h5py.File(path.parent / "hop.bin", "w") as file:
        file["on"] = h5py.ExternalLink(str(away), "/there")
    with h5py.File(path, "a") as file:
        file[name] = h5py.ExternalLink("hop.bin", "/on")


def a_virtual_array(path, name, away):
    shape, dtype = moved(path, name, away)
    layout = h5py.VirtualLayout(shape, dtype)
    layout[:] = h5py.VirtualSource(str(away), "there", shape)
    with h5py.File(path, "a") as file:
        file.create_virtual_dataset(name, layout)


def a_virtual_array_of_a_link(path, name, away):
    """Of an array in the same file, which is a link."""
    shape, dtype = moved(path, name, away)
    layout = h5py.VirtualLayout(shape, dtype)
    layout[:] = h5py.VirtualSource(".", "inner", shape)
    with h5py.File(path, "a") as file:
        file["inner"] = h5py.ExternalLink(str(away), "/there")
        file.create_virtual_dataset(name, layout)


def raw_bytes(path, name, away):
    with h5py.File(path, "a") as file:
        values = file[name][()]
        del file[name]
        away.write_bytes(b"head" + values.tobytes())
        place = [(str(away), 4, values.nbytes)]
        file.create_dataset(name, values.shape, values.dtype, external=place)


KINDS = [
    *(a_link, a_relative_link, a_soft_link_over_a_link, two_links),
    *(a_virtual_array, a_virtual_array_of_a_link, raw_bytes),
]


def contents(root, form=HDF5, **options):
    """Frames and actions of all recordings."""
    splits = form().read(root, **options).splits
    parts = splits.values() if isinstance(splits, dict) else [splits]
    found = []
    for part in parts:
        for index in range(len(part)):
            recording = part[index]
            (frames,) = recording.cameras.values()
            shown = np.stack([*frames.read(range(len(frames.times)))])
            found.append((recording.name, shown, recording.actions.values))
    hdf5_store._file.cache_clear()  # an open file could not be changed
    return found


def same(one, other):
    assert [name for name, *_ in one] == [name for name, *_ in other]
    for (_, *mine), (_, *theirs) in zip(one, other, strict=True):
        for a, b in zip(mine, theirs, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.fixture
def folder(tmp_path):
    """Three files of ALOHA, and what they hold."""
    path = tmp_path / "source"
    path.mkdir()
    arrays.aloha(path, PLAIN)
    return path, path / "episode_1.hdf5", contents(path, rate=10)


def problem(path, form=HDF5, **options):
    """The sentence by which reading ends."""
    with pytest.raises(DataError) as error:
        contents(path, form, **options)
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize("make", KINDS, ids=lambda make: make.__name__)
def test_references_lead_out_only_if_they_may(folder, tmp_path, make):
    path, spoilt, before = folder
    make(spoilt, CAMERA, tmp_path / "there.bin")
    assert f"there.bin, which is not in {path}: give --follow-links" in problem(path, rate=10)
    same(contents(path, rate=10, follow_links=True), before)


@pytest.mark.parametrize("make", KINDS, ids=lambda make: make.__name__)
def test_references_within_the_folder_are_followed(folder, make):
    path, spoilt, before = folder
    make(spoilt, "action", path / "there.bin")
    same(contents(path, rate=10), before)
    assert f"is not in {spoilt}" in problem(spoilt, rate=10)  # of which nobody named the folder


def test_a_link_within_the_folder_may_not_be_a_link_out(folder, tmp_path):
    path, spoilt, _ = folder
    a_link(spoilt, CAMERA, path / "there.bin")
    (path / "there.bin").rename(tmp_path / "there.bin")
    (path / "there.bin").symlink_to(tmp_path / "there.bin")
    assert "is a link that leads out" in problem(path, rate=10)
    with pytest.raises(DataError, match="is not in"):
        open_hdf5(spoilt, path)


def a_pipe(path):
    path.unlink()
    os.mkfifo(path)


def too_short(path):
    path.write_bytes(path.read_bytes()[:-1])


def without_the_array(path):
    with h5py.File(path, "w") as file:
        file["other"] = 1


@pytest.mark.parametrize(
    ("make", "spoil", "said"),
    [
        (a_link, os.remove, "cannot be read (No such file"),
        (a_link, a_pipe, "is not a file"),
        (a_virtual_array, os.remove, "cannot be read (No such file"),
        (a_virtual_array, a_pipe, "is not a file"),
        (a_virtual_array, without_the_array, "has no array there"),
        (raw_bytes, os.remove, "cannot be read (No such file"),
        (raw_bytes, too_short, "bytes, not"),
    ],
)
def test_references_to_what_is_not_there(folder, tmp_path, make, spoil, said):
    """The library would wait for a pipe, and show zeros for what is missing."""
    path, spoilt, _ = folder
    away = tmp_path / "there.bin"
    make(spoilt, CAMERA, away)
    spoil(away)
    assert said in problem(path, rate=10, follow_links=True)


def test_a_numbered_series_is_refused(folder):
    path, spoilt, _ = folder
    (length, *size), dtype = moved(spoilt, CAMERA, path / "part_0.bin")
    shape, unlimited = (length, *size), (h5py.h5s.UNLIMITED, *size)
    virtual, shown = h5py.h5s.create_simple(shape, unlimited), h5py.h5s.create_simple(shape)
    virtual.select_hyperslab((0,) * 4, (h5py.h5s.UNLIMITED, 1, 1, 1), shape, shape)
    described = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    described.set_virtual(virtual, b"part_%b.bin", b"there", shown)
    with h5py.File(spoilt, "a") as file:
        group, name = file["observations/images"].id, b"cam_high"
        h5py.h5d.create(group, name, h5py.h5t.py_create(dtype), virtual, described)
    assert "a numbered series of files, part_%b.bin" in problem(path, rate=10)


def test_files_that_link_to_each_other(folder):
    path, spoilt, before = folder
    for name, other in (("episode_0.hdf5", spoilt.name), (spoilt.name, "episode_0.hdf5")):
        with h5py.File(path / name, "a") as file:
            file["next"] = h5py.ExternalLink(other, "/")
            file["myself"] = h5py.ExternalLink(name, "/")
    same(contents(path, rate=10), before)


@pytest.mark.parametrize("follow", [False, True])
def test_demonstrations_that_lie_in_files_of_their_own(tmp_path, follow):
    """A file that gathers demonstrations by links, beside them or on another disk."""
    path, _ = arrays.robomimic(tmp_path, PLAIN)
    before = contents(path)
    place = tmp_path / "disk" if follow else tmp_path / "demos"
    for folder in {place, tmp_path / "demos"}:
        folder.mkdir()
    with h5py.File(path) as file, h5py.File(tmp_path / "demos/all.hdf5", "w") as gathered:
        gathered.create_group("data").attrs.update(file["data"].attrs)
        for name, demo in file["data"].items():
            with h5py.File(place / f"{name}.hdf5", "w") as own:
                file.copy(demo, own, f"data/{name}")
                own["data"].attrs.update(file["data"].attrs)
            gathered["data"][name] = h5py.ExternalLink(
                str(place / f"{name}.hdf5") if follow else f"{name}.hdf5", f"data/{name}"
            )
    if follow:
        assert "give --follow-links" in problem(tmp_path / "demos")
    found = contents(tmp_path / "demos", follow_links=follow)
    assert len(found) == len(before)  # each once
    same([("", *rest) for _, *rest in found], [("", *rest) for _, *rest in before])


def test_minari_whose_episodes_lie_elsewhere(tmp_path):
    path = minari(tmp_path, "hdf5")
    before = contents(path, Minari, rate=10)
    main = path / "data/main_data.hdf5"
    with h5py.File(main, "a") as file, h5py.File(tmp_path / "one.hdf5", "w") as other:
        file.copy("episode_1", other)
        del file["episode_1"]
        file["episode_1"] = h5py.ExternalLink(str(tmp_path / "one.hdf5"), "/episode_1")
    assert f"is not in {path}: give --follow-links" in problem(path, Minari, rate=10)
    same(contents(path, Minari, rate=10, follow_links=True), before)


def test_links_are_followed_in_another_process(folder, tmp_path):
    path, spoilt, before = folder
    a_virtual_array(spoilt, "action", tmp_path / "there.bin")
    episodes = HDF5().read(path, rate=10, follow_links=True).splits
    found = pickle.loads(pickle.dumps(episodes.part([1])))[1]
    np.testing.assert_array_equal(found.actions.values, before[1][2])


@pytest.mark.parametrize("follow", [[], ["--follow-links"]])
def test_the_option_of_the_command(folder, tmp_path, follow):
    path, spoilt, _ = folder
    a_link(spoilt, CAMERA, tmp_path / "there.bin")
    done = run(None, path, tmp_path / "data", {"rate": 10}, *follow)
    if follow:
        assert done.exit_code == 0, done.output
    else:
        assert "give --follow-links to read it" in refused(done)
