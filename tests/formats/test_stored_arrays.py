"""HDF5, Zarr and Minari: what their layouts say, and files that reach for others or for code."""

import json
import pickle
import zipfile

import h5py
import numcodecs
import numpy as np
import pytest
import zarr

import acwm_core.arrays
from acwm_core.errors import DataError
from acwm_formats import packed
from acwm_formats.hdf5 import HDF5
from acwm_formats.minari_datasets import Minari
from acwm_formats.packed import GZIP, ZSTD, check_packed, zstd_size
from acwm_formats.zarr_replay import ZarrReplay
from tests.formats.corpus import arrays
from tests.formats.corpus.cases import Case, three
from tests.formats.corpus.pictures import number_in

PLAIN = Case("plain", three(rate=20), rate=20)


def shown(recording):
    (frames,) = recording.cameras.values()
    return [int(number_in(frame)) for frame in frames.read(range(len(frames.times)))]


def test_robomimic_tells_its_rate_kind_and_tests(tmp_path):
    path, _ = arrays.robomimic(tmp_path, PLAIN)
    with h5py.File(path, "a") as file:
        file["mask/train"] = [b"demo_0", b"demo_2"]
        file["mask/valid"] = [b"demo_1"]
    found = HDF5().read(path)
    assert found.actions.kind == "delta"
    assert [*map(len, found.splits.values())] == [2, 1]
    recording = found.splits["ind_test"][0]
    assert (recording.rate, [*recording.states]) == (20, ["robot0_eef_pos"])
    assert shown(recording) == [*PLAIN.episodes[1].numbers]
    np.testing.assert_array_equal(recording.actions.values, PLAIN.episodes[1].rows)


def test_demonstrations_are_in_the_order_of_their_numbers(tmp_path):
    path, _ = arrays.robomimic(tmp_path, PLAIN)
    with h5py.File(path, "a") as file:
        file.move("data/demo_1", "data/demo_10")
    assert shown(HDF5().read(path).splits[2]) == [*PLAIN.episodes[1].numbers]


def test_a_rate_that_nobody_says_is_asked_for(tmp_path):
    path, options = arrays.mapped(tmp_path, PLAIN)
    with pytest.raises(DataError, match="give --rate"):
        HDF5().read(path, video=options["video"], actions=options["actions"])
    with pytest.raises(DataError, match="give --video and --actions"):
        HDF5().read(path, rate=10)
    with pytest.raises(DataError, match="no group with cmd and obs/back"):
        HDF5().read(path, video="obs/back", actions="cmd", rate=10)
    assert not HDF5.detect(path)


class Bomb:
    def __reduce__(self):
        return pytest.fail, ("code of a file was run",)


@pytest.mark.parametrize("codec", ["pickle", "vlen-utf8"])
def test_codecs_that_run_code_are_refused(tmp_path, codec):
    path, options = arrays.replay(tmp_path, PLAIN)
    described = json.loads((path / "data/action/.zarray").read_text())
    forged = {**described, "filters": [{"id": codec}], "compressor": None}
    (path / "data/action/.zarray").write_text(json.dumps(forged))
    for chunk in (path / "data/action").glob("[0-9]*"):
        chunk.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(DataError, match=codec):
        ZarrReplay().read(path, **options)


@pytest.mark.parametrize("codec", ["zstd", "gzip", "bz2", "zlib"])
def test_chunks_that_unpack_to_gigabytes_are_refused(tmp_path, monkeypatch, codec):
    for module in (acwm_core.arrays, packed):
        monkeypatch.setattr(module, "LARGE", 2**20)  # in place of 256 MB
    path, options = arrays.replay(tmp_path, PLAIN)
    described = json.loads((path / "data/img/.zarray").read_text())
    described |= {"compressor": {"id": codec, "level": 1}, "filters": None}
    (path / "data/img/.zarray").write_text(json.dumps(described))
    bomb = numcodecs.get_codec({"id": codec, "level": 1}).encode(bytes(3 * 2**20))
    for chunk in (path / "data/img").glob("[0-9]*"):
        chunk.write_bytes(bomb)
    recording = ZarrReplay().read(path, **options).splits[0]
    with pytest.raises(DataError, match="claim to hold"):
        next(iter(recording.cameras["img"].read([0])))


@pytest.mark.parametrize("codec", ["zstd", "gzip", "bz2", "zlib", "lz4", "lzma"])
def test_sound_chunks_are_read(codec):
    rng = np.random.default_rng(0)
    for data in (bytes(10**6), rng.bytes(10**5), b""):
        check_packed(numcodecs.get_codec({"id": codec}).encode(data))
        check_packed(ZSTD + data)
        check_packed(GZIP + data)
    whole = numcodecs.get_codec({"id": "zstd"}).encode(rng.bytes(10**6))
    assert zstd_size(whole) == 10**6


def test_chunks_that_a_copy_lacks_are_named(tmp_path):
    path, options = arrays.replay(tmp_path, PLAIN)
    (path / "data/img/1.0.0.0").unlink()
    (note,) = ZarrReplay().read(path, **options).notes
    assert "1 of 7 chunks of img are not stored, and read as 0" in note


def test_texts_are_named_and_hidden_arrays_are_not_read(tmp_path):
    path, options = arrays.replay(tmp_path, PLAIN)
    group = zarr.open_group(str(path), mode="a", zarr_format=2)
    group.create_array("data/task", data=np.array(["push"] * 27))
    (path / "data/state").rename(path / "data/.state")  # whose links nobody looked at
    recorded = ZarrReplay().read(path, **options)
    kept = "Texts were kept as facts of the episodes: task. No model reads them."
    assert recorded.notes == (kept,)
    assert recorded.splits[0].states == {}


def test_a_buffer_in_one_file(tmp_path):
    path, options = arrays.replay(tmp_path, PLAIN)
    with zipfile.ZipFile(tmp_path / "packed.zarr.zip", "w") as archive:
        for file in sorted(each for each in path.rglob("*") if each.is_file()):
            archive.write(file, file.relative_to(path).as_posix())
    packed = tmp_path / "packed.zarr.zip"
    assert ZarrReplay.detect(packed)
    recordings = pickle.loads(pickle.dumps(ZarrReplay().read(packed, **options).splits))
    assert shown(recordings[2]) == [*PLAIN.episodes[2].numbers]


def test_lengths_that_disagree(tmp_path):
    path, options = arrays.replay(tmp_path, PLAIN)
    ends = zarr.open_array(str(path / "meta/episode_ends"), mode="r+")
    ends[:] = [8, 17, 99]
    with pytest.raises(DataError, match="27 rows, but the last episode ends at 99"):
        ZarrReplay().read(path, **options)


def test_minari_that_would_make_an_environment_is_refused(tmp_path):
    """Without its spaces the library makes the environment that the file names: code."""
    path, options = arrays.minari(tmp_path, PLAIN)
    file = path / "data/metadata.json"
    metadata = json.loads(file.read_text())
    del metadata["action_space"]
    metadata["env_spec"] = json.dumps({"id": "x", "entry_point": "pytest:fail"})
    file.write_text(json.dumps(metadata))
    with pytest.raises(DataError, match="does not state its spaces"):
        Minari().read(path, **options)


def test_minari_has_one_action_less(tmp_path):
    path, options = arrays.minari(tmp_path, PLAIN)
    assert Minari.detect(path)
    recording = Minari().read(path, **options).splits[1]
    assert shown(recording) == [*PLAIN.episodes[1].numbers]
    np.testing.assert_array_equal(recording.actions.values, PLAIN.episodes[1].rows[:-1])
