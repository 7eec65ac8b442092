"""Shards as somebody with bad intentions would make them: one sentence each, and no harm."""

import io
import json
import subprocess
import sys
import tarfile
import zipfile
import zlib

import numpy as np
import pytest

from acwm_core.data.shards import MAX_JSON, from_npy, from_npz, open_shard, write_shard
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.data.video import encode_masks, encode_video
from acwm_core.episode import EpisodeSpec
from acwm_core.errors import DataError

KEY = "train-000000"
SIZE = (32, 32)


@pytest.fixture(scope="module")
def members(tmp_path_factory):
    """The members of a sound episode by name."""
    path = tmp_path_factory.mktemp("sound") / "shard-00000.tar"
    write_shard(
        path, [simulate(make_environment("square"), EpisodeSpec("square", "train", 0))], 10, {}
    )
    with tarfile.open(path) as tar:
        return {info.name.partition(".")[2]: tar.extractfile(info).read() for info in tar}


def member(name, data=b"", **header):
    """A tar header and its contents; `header` sets fields of it."""
    info = tarfile.TarInfo(name)
    info.size = len(data)
    for field, value in header.items():
        setattr(info, field, value)
    return info.tobuf(header.pop("format", tarfile.GNU_FORMAT)) + data + bytes(-len(data) % 512)


def tar_of(tmp_path, *parts):
    path = tmp_path / "shard-00000.tar"
    path.write_bytes(b"".join(parts) + bytes(1024))
    return path


def forged(tmp_path, members, **changes):
    """A shard of one episode with other members, under the right checksums."""
    changes = {name.replace("_", "."): data for name, data in changes.items()}
    contents = {**members, **changes}
    if "json" not in changes:
        about = json.loads(contents["json"])
        about["crc32"] = {name: zlib.crc32(data) for name, data in contents.items()}
        contents["json"] = json.dumps(about).encode()
    return tar_of(tmp_path, *(member(f"{KEY}.{name}", data) for name, data in contents.items()))


def npy(array, **how):
    buffer = io.BytesIO()
    np.save(buffer, array, **how)
    return buffer.getvalue()


def npy_that_claims(shape, descr="<f4", data=b"\0" * 64):
    buffer = io.BytesIO()
    header = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, header)
    return buffer.getvalue() + data


def npz(compression=zipfile.ZIP_STORED, **arrays):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, data in arrays.items():
            archive.writestr(f"{name}.npy", data)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        ({"name": f"/{KEY}.json"}, "no part of an episode"),
        ({"name": f"../{KEY}.json"}, "no part of an episode"),
        ({"name": f"train/../../{KEY}.json"}, "no part of an episode"),
        ({"name": "/etc/passwd"}, "no part of an episode"),
        ({"name": f"{KEY}.sh"}, "no part of an episode"),
        ({"name": f"{KEY}.json", "type": tarfile.SYMTYPE, "linkname": "/etc/passwd"}, "a link"),
        ({"name": f"{KEY}.json", "type": tarfile.LNKTYPE, "linkname": "x"}, "a link"),
        ({"name": f"{KEY}.json", "type": tarfile.FIFOTYPE}, "special file"),
        ({"name": f"{KEY}.json", "type": tarfile.CHRTYPE}, "special file"),
        ({"name": f"{KEY}.json", "type": tarfile.DIRTYPE}, "special file"),
        ({"name": f"{KEY}.json", "type": tarfile.GNUTYPE_SPARSE}, "special file"),
        ({"name": "././@PaxHeader", "type": tarfile.XHDTYPE, "size": 2**40}, "no part of"),
        ({"name": "././@LongLink", "type": tarfile.GNUTYPE_LONGNAME, "size": 2**40}, "no part of"),
        ({"name": f"{KEY}.json", "size": 2**33}, "cut off: it ends within"),
        ({"name": f"{KEY}.json", "size": 2**70}, "cut off: it ends within"),
        ({"name": f"{KEY}.json", "size": -512}, "cut off: it ends within"),
    ],
)
def test_members_that_no_episode_has_are_refused(header, reason, members, tmp_path):
    sound = [member(f"{KEY}.{name}", data) for name, data in members.items()]
    path = tar_of(tmp_path, *sound, member(header.pop("name").replace("000", "001"), **header))
    with pytest.raises(DataError, match=rf"shard-00000\.tar is damaged \(.*{reason}"):
        open_shard(path)


def test_a_member_that_is_there_twice_is_refused(members, tmp_path):
    sound = [member(f"{KEY}.{name}", data) for name, data in members.items()]
    path = tar_of(tmp_path, *sound, sound[-1])
    with pytest.raises(DataError, match=rf"it holds {KEY}\.json twice"):
        open_shard(path)


def test_a_sound_one_is_read(members, tmp_path):
    assert len(open_shard(forged(tmp_path, members)).episode(0, SIZE).video) == 21


def changes():
    """Members that a shard of ours never holds, and what is said of them."""
    numbers = npy(np.zeros((21, 2), np.float32))
    noise = npy(np.random.default_rng(0).normal(size=(21, 2)))
    frames = np.zeros((21, 64, 32, 3), np.uint8)
    many = np.zeros((5000, *SIZE, 3), np.uint8)
    yield "actions_npy", npy_that_claims((2**40, 2)), "claims float32"
    yield "actions_npy", npy_that_claims((-1, 2)), "actions.npy of episode 0"
    yield "actions_npy", npy_that_claims((2**62, 2**62)), "actions.npy of episode 0"
    yield "actions_npy", npy(np.zeros((21, 2))), "it is float64"
    yield "actions_npy", npy(np.zeros(42, np.float32)), r"it is float32 \(42,\)"
    yield "actions_npy", npy(np.array(["x"])), "not numbers"
    yield "actions_npy", npy(np.array([print]), allow_pickle=True), "pickled objects"
    yield "actions_npy", b"\x93NUMPY\x02\x00" + numbers[8:], "version"
    yield "contacts_npy", npy(np.zeros((3, 3))), "it is float64"
    yield "states_npz", npz(position=npy_that_claims((2**40,))), "claims float32"
    yield "states_npz", npz(zipfile.ZIP_DEFLATED, position=npy(np.zeros(2**22))), "claims more"
    yield "states_npz", npz(zipfile.ZIP_DEFLATED, position=noise), "compressed"
    yield "states_npz", npz(position=npy(np.array([print]), allow_pickle=True)), "pickled"
    yield "states_npz", npz(position=npy(np.zeros((5, 2)))), "has 5 rows"
    yield "states_npz", b"PK" + bytes(100), "states.npz of episode 0"
    yield "json", b"[" * 100_000, "json of episode 0"
    yield "json", b"[]", "no JSON object"
    yield "json", b'{"crc32": []}', "no JSON object"
    yield "json", b'{"x": "' + b"a" * MAX_JSON + b'"}', r"it has \d+ bytes"
    yield "video_mkv", encode_video(frames), "its frames are 64×32, not 32×32"
    yield "video_mkv", encode_video(many), "more than 21 frames"
    yield "mask_mkv", encode_masks(frames[..., 0]), "its frames are 64×32"


@pytest.mark.parametrize(("name", "data", "reason"), [*changes()])
def test_contents_that_no_episode_has_are_refused(name, data, reason, members, tmp_path):
    reader = open_shard(forged(tmp_path, members, **{name: data}))
    with pytest.raises(DataError, match=rf"shard-00000\.tar is damaged \(.*{reason}") as raised:
        reader.episode(0, SIZE)
    assert "\n" not in str(raised.value)


def test_a_video_whose_container_lies_about_its_size_is_refused(members, tmp_path):
    """The container says 32×32, the stream in it 512×512."""
    large = encode_video(np.zeros((21, 512, 512, 3), np.uint8))
    lie = large
    for field in (b"\xb0", b"\xba"):  # Matroska's PixelWidth and PixelHeight, of two bytes each
        assert large.count(field + b"\x82\x02\x00") == 1
        lie = lie.replace(field + b"\x82\x02\x00", field + b"\x82\x00\x20")
    reader = open_shard(forged(tmp_path, members, video_mkv=lie))
    with pytest.raises(DataError, match="its frames are 512×512, not 32×32"):
        reader.episode(0, SIZE)


HUNGRY = """
import resource, sys
from acwm_core.data.shards import open_shard
from acwm_core.errors import DataError
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sys.argv[1:]:
    try:
        open_shard(__import__("pathlib").Path(path)).episode(0, (32, 32))
    except DataError:
        pass
    else:
        sys.exit(f"{path} was read")
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def test_bombs_cost_no_memory(members, tmp_path):
    """A process that reads them all grows by less than 40 MB."""
    zeros = np.zeros((1, 2**13, 2**13, 3), np.uint8)
    bombs = [(name, data) for name, data, _ in changes()] + [("video_mkv", encode_video(zeros))]
    paths = []
    for number, (name, data) in enumerate(bombs):
        folder = tmp_path / str(number)
        folder.mkdir()
        paths.append(str(forged(folder, members, **{name: data})))
    done = subprocess.run(
        [sys.executable, "-c", HUNGRY, *paths], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 40_000  # kB; one frame of the largest takes 200 MB


def test_arrays_are_read_as_numpy_wrote_them():
    rng = np.random.default_rng(0)
    for array in (rng.normal(size=(3, 4)), np.asfortranarray(rng.normal(size=(3, 4))), np.ones(())):
        np.testing.assert_array_equal(from_npy(npy(array)), array)
    for dtype in (bool, np.uint8, np.int64, ">f4"):
        np.testing.assert_array_equal(from_npy(npy(np.ones(3, dtype))), np.ones(3, dtype))
    assert from_npy(npy(np.zeros((0, 3), np.int32))).shape == (0, 3)
    stored = npz(a=npy(np.ones(3)), b=npy(np.zeros(2)))
    assert sorted(from_npz(stored)) == ["a", "b"]
