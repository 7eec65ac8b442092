"""HDF5, Zarr and Minari: what their layouts say, and files that reach for others or for code."""

import json
import lzma
import pickle
import zipfile
import zlib

import google_crc32c
import h5py
import numcodecs
import numpy as np
import pytest
import zarr

from acwm_core.errors import DataError
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


CODECS = {
    "blosc": numcodecs.Blosc("lz4"),
    "zstd": numcodecs.Zstd(),
    "gzip": numcodecs.GZip(),
    "bz2": numcodecs.BZ2(),
    "zlib": numcodecs.Zlib(),
    "lz4": numcodecs.LZ4(),
    "lzma": numcodecs.LZMA(),
    "old lzma": numcodecs.LZMA(format=lzma.FORMAT_ALONE),
}


def replaced(path, codec, chunk):
    """Say that frames are compressed by a codec, and put the same bytes into all chunks."""
    described = json.loads((path / "data/img/.zarray").read_text())
    described |= {"compressor": codec.get_config(), "filters": None}
    (path / "data/img/.zarray").write_text(json.dumps(described))
    for place in (path / "data/img").glob("[0-9]*"):
        place.write_bytes(chunk)


def first_frame(path, options):
    return next(iter(ZarrReplay().read(path, **options).splits[0].cameras["img"].read([0])))


@pytest.mark.parametrize("codec", CODECS.values(), ids=CODECS)
def test_chunks_of_every_codec(tmp_path, codec):
    path, options = arrays.replay(tmp_path, PLAIN)
    chunks = zarr.open_array(str(path / "data/img"), mode="r").chunks
    frames = np.random.default_rng(0).integers(0, 256, chunks, np.uint8)
    replaced(path, codec, codec.encode(frames))
    np.testing.assert_array_equal(first_frame(path, options), frames[0])
    replaced(path, codec, codec.encode(bytes(3 * 2**20)))
    with pytest.raises(DataError, match="unpack to more than the 1,"):
        first_frame(path, options)


SECOND = {
    "zstd": numcodecs.Zstd().encode(b"1"),
    "a frame that zstd skips": b"\x50\x2a\x4d\x18\x02\x00\x00\x00ab",
    "gzip": numcodecs.GZip().encode(b"1"),
    "bz2": numcodecs.BZ2().encode(b"1"),
    "lzma": numcodecs.LZMA().encode(b"1"),
}


@pytest.mark.parametrize("before", SECOND)
def test_bombs_behind_a_harmless_beginning(tmp_path, before):
    path, options = arrays.replay(tmp_path, PLAIN)
    codec = CODECS.get(before, CODECS["zstd"])
    replaced(path, codec, SECOND[before] + codec.encode(bytes(3 * 2**20)))
    with pytest.raises(DataError, match="unpack to more than the 1,"):
        first_frame(path, options)


def test_bombs_by_another_header_and_claims(tmp_path):
    path, options = arrays.replay(tmp_path, PLAIN)
    small = zlib.compressobj(9, zlib.DEFLATED, 10)
    replaced(path, CODECS["zlib"], small.compress(bytes(3 * 2**20)) + small.flush())
    with pytest.raises(DataError, match="unpack to more than the 1,"):
        first_frame(path, options)
    replaced(path, CODECS["lz4"], (2**31 - 1).to_bytes(4, "little") + b"aaaa")
    with pytest.raises(DataError, match="8 bytes claim to hold 2,147,483,647"):
        first_frame(path, options)
    check_packed((3).to_bytes(4, "little") + bytes(12), "vlenutf8")
    with pytest.raises(ValueError, match="4 bytes claim to hold 17,179,869,176"):
        check_packed((2**31 - 1).to_bytes(4, "little"), "vlenutf8")


def sharded(path, compressor):
    """The same as `arrays.replay`, in shards of six frames, and what is in them."""
    frames = np.random.default_rng(0).integers(0, 256, (18, 32, 32, 3), np.uint8)
    group = zarr.open_group(str(path), mode="w", zarr_format=3)
    inner, outer = (1, 32, 32, 3), (6, 32, 32, 3)
    group.create_array("data/img", data=frames, chunks=inner, shards=outer, compressors=compressor)
    group.create_array("data/action", data=np.zeros((18, 2), np.float32))
    group.create_array("meta/episode_ends", data=np.array([6, 12, 18]))
    return frames


IN_SHARDS = {
    "gzip": (zarr.codecs.GzipCodec(), CODECS["gzip"]),
    "zstd": (zarr.codecs.ZstdCodec(), CODECS["zstd"]),
    "blosc": (zarr.codecs.BloscCodec(), CODECS["blosc"]),
    "lz4": (zarr.codecs.numcodecs.LZ4(), CODECS["lz4"]),
}


@pytest.mark.filterwarnings("ignore:Numcodecs codecs are not in the Zarr version 3")
@pytest.mark.parametrize(("compressor", "codec"), IN_SHARDS.values(), ids=IN_SHARDS)
def test_chunks_in_shards(tmp_path, compressor, codec):
    path = tmp_path / "b.zarr"
    frames = sharded(path, compressor)
    np.testing.assert_array_equal(first_frame(path, {"rate": 10}), frames[0])
    bomb = codec.encode(bytes(3 * 2**20))
    index = np.array([[place * len(bomb), len(bomb)] for place in range(6)], "<u8").tobytes()
    check = index + google_crc32c.value(index).to_bytes(4, "little")
    for shard in (path / "data/img/c").rglob("*"):
        if shard.is_file():
            shard.write_bytes(bomb * 6 + check)
    with pytest.raises(DataError, match="unpack to more than the 1,"):
        first_frame(path, {"rate": 10})


def forge(path, array, **changes):
    place = path / array / "zarr.json"
    place.write_text(json.dumps(json.loads(place.read_text()) | changes))


def test_zarr_that_is_more_than_it_can_be(tmp_path):
    path = tmp_path / "b.zarr"
    sharded(path, zarr.codecs.ZstdCodec())
    about = json.loads((path / "data/img/zarr.json").read_text())
    about["codecs"][0]["configuration"]["chunk_shape"] = [1, 1, 1, 1]
    about["chunk_grid"]["configuration"]["chunk_shape"] = [6, 4096, 4096, 3]
    forge(path, "data/img", shape=[18, 4096, 4096, 3], **{k: about[k] for k in FORGED})
    with pytest.raises(DataError, match="claims 301,989,888 chunks in a row or shard"):
        ZarrReplay().read(path, rate=10)
    sharded(path, zarr.codecs.ZstdCodec())
    for array, row in (("data/img", [32, 32, 3]), ("data/action", [2])):
        forge(path, array, shape=[10**7, *row])
    zarr.open_array(str(path / "meta/episode_ends"), mode="r+")[:] = [6, 12, 10**7]
    with pytest.raises(DataError, match=r"claims 30,720,000,000 bytes in \d"):
        ZarrReplay().read(path, rate=10)


FORGED = ("codecs", "chunk_grid")


def test_codecs_that_are_not_read_are_named(tmp_path):
    path, options = arrays.replay(tmp_path, PLAIN)
    twice = CODECS["zlib"].encode(CODECS["zlib"].encode(bytes(100)))
    replaced(path, CODECS["zlib"], twice)
    described = json.loads((path / "data/img/.zarray").read_text())
    for change, why in (
        ({"filters": [{"id": "zlib"}]}, "compressed 2 times: store it with one codec"),
        ({"compressor": {"id": "pcodec"}}, "stored by pcodec, which is not read"),
        ({"compressor": {"id": "imagecodecs_jpegxl"}}, "by imagecodecs_jpegxl, which is not read"),
    ):
        (path / "data/img/.zarray").write_text(json.dumps(described | change))
        with pytest.raises(DataError, match=why):
            ZarrReplay().read(path, **options)


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


def test_files_of_other_programs_beside_arrays_are_left_out_without_a_warning(tmp_path, recwarn):
    path, options = arrays.replay(tmp_path, PLAIN)
    for folder in (path, path / "data", path / "meta"):
        for name in (".DS_Store", "._data", "Thumbs.db", "notes.txt"):
            (folder / name).write_bytes(b"\0\5\x16\7")
    assert ZarrReplay().read(path, **options).notes == ()
    assert [str(warning.message) for warning in recwarn] == []


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
