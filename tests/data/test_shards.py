"""Shards: exact, deterministic, readable by WebDataset; damage is named, nothing half-written."""

import io
import json
import tarfile

import numpy as np
import pytest
from forging import npy, zipped

from acwm_core.arrays import from_npy, from_npz
from acwm_core.data.shards import MEMBERS, ShardRecord, open_shard, write_shard
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.errors import DataError
from tests.episodes import assert_same

VERSIONS = {"acwm": "1"}


@pytest.fixture(scope="module")
def episodes():
    square = make_environment("square")
    return [simulate(square, EpisodeSpec("square", "ood_test", i)) for i in range(3)]


@pytest.fixture
def shard(tmp_path, episodes):
    path = tmp_path / "shard-00000.tar"
    record = write_shard(path, episodes, 10, VERSIONS)
    assert record == ShardRecord.of_file(path, 0)
    return path


def rewritten(shard, name, data):
    """A copy of `shard` whose second episode's member `name` holds `data`."""
    copy = shard.with_name("copy.tar")
    with tarfile.open(shard) as source, tarfile.open(copy, "w") as target:
        for info in source:
            content = source.extractfile(info).read()
            if info.name == f"ood_test-000001.{name}":
                content = data
            info.size = len(content)
            target.addfile(info, io.BytesIO(content))
    return copy


def test_episodes_come_back_exactly(shard, episodes):
    reader = open_shard(shard)
    assert len(reader) == 3
    for position in (2, 0, 1):
        read = reader.episode(position)
        assert_same(read, episodes[position])
        assert read.spec == episodes[position].spec
    assert reader.about(1)["versions"] == VERSIONS


def test_webdataset_reads_the_same(shard, episodes):
    webdataset = pytest.importorskip("webdataset")
    samples = list(webdataset.WebDataset(str(shard), shardshuffle=False).decode())
    assert [sample["__key__"] for sample in samples] == [f"ood_test-00000{i}" for i in range(3)]
    for sample, episode in zip(samples, episodes, strict=True):
        assert set(MEMBERS) <= set(sample)
        np.testing.assert_array_equal(sample["actions.npy"], episode.actions)
        np.testing.assert_array_equal(sample["contacts.npy"], episode.contacts)
        np.testing.assert_array_equal(sample["states.npz"]["position"], episode.states["position"])
        assert sample["json"]["ood_label"] == episode.ood_label
        assert sample["json"]["factors"] == episode.factors
        assert sample["json"]["spec"]["index"] == episode.spec.index


def test_equal_episodes_make_equal_bytes(shard, episodes):
    again = shard.with_name("again.tar")
    write_shard(again, iter(episodes), 10, VERSIONS)
    assert again.read_bytes() == shard.read_bytes()
    with tarfile.open(shard) as tar:
        assert {(m.mtime, m.uid, m.gid, m.uname, m.mode) for m in tar} == {(0, 0, 0, "", 0o644)}


def test_a_failing_writer_leaves_nothing(tmp_path, episodes):
    def failing():
        yield episodes[0]
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        write_shard(tmp_path / "shard.tar", failing(), 10, VERSIONS)
    assert not list(tmp_path.iterdir())


def test_a_missing_shard_says_what_to_do(shard):
    reader = open_shard(shard)
    shard.unlink()
    for read in (lambda: reader.read(0, "json"), lambda: open_shard(shard)):
        with pytest.raises(DataError, match=r"shard-00000.tar is missing: run the command"):
            read()


@pytest.mark.parametrize("keep", [0.0, 0.1, 0.5, 0.7])
def test_a_cut_off_shard_is_noticed(shard, keep):
    data = shard.read_bytes()
    shard.write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(DataError, match=r"shard-00000.tar is damaged .*: delete it"):
        open_shard(shard)


def test_a_shard_cut_off_between_members_is_noticed(shard):
    with tarfile.open(shard) as tar:
        boundary = tar.getmembers()[7].offset
    shard.write_bytes(shard.read_bytes()[:boundary])
    for lost in (1, 2):
        with pytest.raises(DataError, match=rf"damaged \(episode {lost} has no json"):
            open_shard(shard).episode(lost)


def test_a_shard_that_shrinks_behind_the_reader_is_noticed(shard):
    reader = open_shard(shard)
    data = shard.read_bytes()
    shard.write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match="it ends within"):
        reader.episode(2)


@pytest.mark.parametrize("name", MEMBERS)
def test_a_damaged_member_is_named(shard, name):
    copy = rewritten(shard, name, b"\0" * 64)
    reader = open_shard(copy)
    assert_same(reader.episode(0), open_shard(shard).episode(0))
    with pytest.raises(DataError, match=rf"copy.tar is damaged \({name} of episode 1"):
        reader.episode(1)


def test_a_single_flipped_bit_is_noticed(shard):
    data = bytearray(shard.read_bytes())
    member = open_shard(shard).episodes[1]["video.mkv"]
    data[member.offset + member.size // 2] ^= 4
    shard.write_bytes(data)
    with pytest.raises(DataError, match=r"video\.mkv of episode 1 has another checksum"):
        open_shard(shard).episode(1)


def test_an_episode_without_a_member_is_refused(shard):
    bare = shard.with_name("bare.tar")
    with tarfile.open(bare, "w") as tar:
        tar.addfile(tarfile.TarInfo("train-000000.json"))
    with pytest.raises(DataError, match=r"episode 0 has no video\.mkv"):
        open_shard(bare).read(0, "video.mkv")


def test_arrays_are_read_as_numpy_wrote_them():
    rng = np.random.default_rng(0)
    for array in (rng.normal(size=(3, 4)), np.asfortranarray(rng.normal(size=(3, 4))), np.ones(())):
        np.testing.assert_array_equal(from_npy(npy(array)), array)
    for dtype in (bool, np.uint8, np.int64, ">f4"):
        np.testing.assert_array_equal(from_npy(npy(np.ones(3, dtype))), np.ones(3, dtype))
    assert from_npy(npy(np.zeros((0, 3), np.int32))).shape == (0, 3)
    stored = zipped({"a.npy": npy(np.ones(3)), "b.npy": npy(np.zeros(2))})
    assert sorted(from_npz(stored)) == ["a", "b"]


def test_a_replaced_shard_is_indexed_anew(shard, episodes):
    assert len(open_shard(shard)) == 3
    write_shard(shard, episodes[:1], 10, VERSIONS)
    reader = open_shard(shard)
    assert len(reader) == 1
    assert json.loads(reader.read(0, "json"))["spec"]["index"] == 0
