"""Datasets made to do harm: each gets one clear sentence, costs little and changes nothing.

Their checksums are right, as those of somebody with bad intentions would be.
"""

import hashlib
import io
import json
import os
import pickle
import shutil
import subprocess
import sys
import tarfile
import textwrap
import zipfile
from pathlib import Path

import av
import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from conftest import checksums
from forging import forge, npy, problems, replaced, sign

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_core.data.manifest import MANIFEST
from acwm_core.errors import DataError

SHARD = "train/shard-00000.tar"
GIGABYTE = 2**30


@pytest.fixture
def data(square_data, tmp_path):
    return shutil.copytree(square_data, tmp_path / "data")


def refused(folder, what=SHARD):
    """The one problem there is; the check wrote nothing and found the rest sound."""
    before = checksums(folder)
    found = problems(folder, replays=0)
    assert checksums(folder) == before
    assert list(found) == [what]
    assert "\n" not in found[what]
    return found[what]


class Attack:
    """Makes a file when it is unpickled."""

    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.system, (f"touch {self.mark}",)


def zipped(arrays, method=zipfile.ZIP_STORED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in arrays.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def header(shape, dtype="<f4"):
    """A ``.npy`` file that claims a shape and holds nothing."""
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        buffer, {"descr": dtype, "fortran_order": False, "shape": shape}
    )
    return buffer.getvalue()


def film(height, width, frames=2):
    """A black video, which takes few bytes whatever its size."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="matroska") as output:
        stream = output.add_stream("libx264rgb", rate=10)
        stream.height, stream.width, stream.pix_fmt = height, width, "rgb24"
        stream.options = {"qp": "0", "preset": "ultrafast"}
        for _ in range(frames):
            frame = av.VideoFrame(width, height, "rgb24")
            frame.planes[0].update(bytes(frame.planes[0].buffer_size))
            output.mux(stream.encode(frame))
        output.mux(stream.encode(None))
    return buffer.getvalue()


@pytest.mark.parametrize("member", ["actions.npy", "contacts.npy", "states.npz"])
def test_pickles_are_never_loaded(data, tmp_path, member):
    mark = tmp_path / "mark"
    attack = npy(np.array([Attack(mark)], object))
    if member == "states.npz":
        attack = zipped({"position.npy": attack})
    forge(data, replaced(f"train-000001.{member}", attack))
    assert "pickled" in refused(data)
    assert not mark.exists()
    np.load(io.BytesIO(npy(np.array([Attack(mark)], object))), allow_pickle=True)
    assert mark.exists()  # the attack is real


@pytest.mark.parametrize("name", ["/etc/cron.d/evil", "../../evil", "a/../../../evil", "evil.sh"])
def test_paths_that_lead_out_are_refused_and_nothing_is_extracted(data, tmp_path, name):
    def change(info, content):
        if info.name == "train-000002.actions.npy":
            info.name = name
        return info, content

    forge(data, change)
    assert name in refused(data)
    assert not list(tmp_path.rglob("evil*"))


@pytest.mark.parametrize(
    "kind",
    [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.FIFOTYPE, tarfile.CHRTYPE, tarfile.DIRTYPE],
    ids=["symlink", "hardlink", "fifo", "device", "folder"],
)
def test_members_that_are_no_files_are_refused(data, kind):
    def change(info, content):
        if info.name == "train-000001.video.mkv":
            info.type, info.linkname, content = kind, "/etc/passwd", b""
        return info, content

    forge(data, change)
    assert "not a plain file" in refused(data)


def test_members_that_claim_to_be_endless_are_refused(data):
    path = data / SHARD
    content = bytearray(path.read_bytes())
    for size in (8 * GIGABYTE - 1, 2**62):
        field = f"{size:011o}\0".encode() if size < 8 * GIGABYTE else b"\x80" + size.to_bytes(11)
        content[124:136] = field
        content[148:156] = b" " * 8
        content[148:156] = f"{sum(content[:512]):06o}\0 ".encode()
        path.write_bytes(content)
        sign(data)
        assert refused(data)


@pytest.mark.parametrize(
    ("member", "content"),
    [
        ("actions.npy", header((10**12, 2))),
        ("actions.npy", header((-1, 2))),
        ("actions.npy", header((2**62, 2**62))),
        ("contacts.npy", header((10**11, 3), "<i4")),
        ("actions.npy", header((10**6, 2)) + bytes(64)),
        ("actions.npy", b"\x93NUMPY\x02\x00" + (2**32 - 1).to_bytes(4, "little")),
        ("actions.npy", b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 60000),
        ("actions.npy", b""),
        ("states.npz", zipped({"position.npy": bytes(2**28)}, zipfile.ZIP_DEFLATED)),
        ("states.npz", zipped({"position.npy": header((10**12, 2), "<f8")})),
        ("states.npz", zipped({"../position.npy": npy(np.zeros((21, 2)))})),
        ("states.npz", b"PK\x05\x06" + bytes(18)),
        ("json", b'{"spec": ' + b"[" * 100000),
        ("json", b" " * 2**22),
        ("json", b"[]"),
        ("json", b'{"crc32": 3, "spec": {}, "factors": 1, "ood_label": 2, "versions": 3}'),
        ("json", b'{"crc32": {}, "spec": {"environment": "square", "evil": 1}}'),
    ],
)
def test_members_that_lie_about_themselves_are_refused(data, member, content):
    forge(data, replaced(f"train-000001.{member}", content))
    assert refused(data)


@pytest.mark.parametrize("member", ["video.mkv", "mask.mkv"])
def test_videos_of_absurd_size_or_length_are_refused(data, member):
    for content in (film(4096, 4096), film(32, 40), film(32, 32, frames=3000), b"#EXTM3U\n/etc/x"):
        forge(data, replaced(f"train-000001.{member}", content))
        assert refused(data)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"shard": "../../../etc/passwd"}, "no name of a shard"),
        ({"shard": "/etc/passwd"}, "no name of a shard"),
        ({"shard": "shard-00000.tar/../../x"}, "no name of a shard"),
        ({"lengths": []}, "impossible counts"),
        ({"lengths": ["21"] * 4}, "impossible counts"),
        ({"size": -1}, "impossible counts"),
        ({"first": None}, "impossible counts"),
        ({"actions": [1]}, "damaged"),
    ],
)
def test_manifests_that_mislead_are_refused(data, change, problem):
    sign(data, **change)
    assert problem in refused(data, f"train/{MANIFEST}")


def test_manifests_that_are_none_are_refused(data):
    path = data / "train" / MANIFEST
    for content in (b"\xff\xfe\x00\n", b"[" * 100000 + b"\n", b"null\n", b"{}\n", b'"shard"\n'):
        path.write_bytes(content)
        assert "damaged" in refused(data, f"train/{MANIFEST}")
    path.unlink()
    assert "0 of 11 episodes" in refused(data, f"train/{MANIFEST}")
    shutil.rmtree(data / "train")
    assert "the folder of the split is missing" in refused(data, f"train/{MANIFEST}")


def test_shards_that_are_something_else_are_refused(data, tmp_path):
    shard, secret = data / SHARD, tmp_path / "secret"
    secret.write_text("mine")
    whole = shard.read_bytes()
    for content in (b"", b"\0" * 10240, zipped({"a": b"b"}), pickle.dumps([1]), whole[:3000]):
        shard.write_bytes(content)
        sign(data)
        assert refused(data)
    shard.unlink()
    shard.symlink_to(secret)
    assert "bytes" in refused(data)
    shard.unlink()
    shard.mkdir()
    assert "missing" in refused(data)
    shard.rmdir()
    os.mkfifo(shard)
    assert "missing" in refused(data)


def card_of(data):
    return yaml.safe_load((data / "card.yaml").read_text())


def nested(**changes):
    """A change of a card by dotted names."""

    def change(card):
        for name, value in changes.items():
            place = card
            *path, last = name.split("__")
            for key in path:
                place = place[key]
            place[last] = value
        return yaml.safe_dump(card)

    return change


BOMB = "a0: &a0 [x, x, x]\n" + "".join(
    f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 30)
)


@pytest.mark.parametrize(
    "change",
    [
        nested(splits={"../../etc": 3}),
        nested(splits={"train": -1}),
        nested(splits={"train": "11"}),
        nested(splits=[]),
        nested(shard_episodes=0),
        nested(environment__frame_size=[10**9, 10**9]),
        nested(environment__frame_size=[32]),
        nested(environment__fps=0),
        nested(environment__horizon="21"),
        nested(environment__action__low=[3.0, 3.0]),
        nested(environment__evil=1),
        lambda card: BOMB + yaml.safe_dump(card),
        lambda card: "!!python/object/apply:os.system ['touch /tmp/acwm-evil']",
        lambda card: "[" * 100000,
        lambda card: "x: " + "y" * 2**23,
        lambda card: "\0\1\2",
    ],
)
def test_cards_that_mislead_are_refused(data, change):
    (data / "card.yaml").write_text(change(card_of(data)))
    with pytest.raises(DataError, match="is no dataset card") as raised:
        DatasetCard.read(data)
    assert "\n" not in str(raised.value)
    result = CliRunner().invoke(main, ["data", "check", str(data)])
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert not Path("/tmp/acwm-evil").exists()


def test_all_of_it_costs_little_memory(data, square_data):
    """Bombs are found by what they claim, not by unpacking them."""
    forge(data, replaced("train-000000.actions.npy", header((10**12, 2))))
    bomb = zipped({"position.npy": bytes(2**28)}, zipfile.ZIP_DEFLATED)
    forge(data, replaced("train-000004.states.npz", bomb), number=1)
    forge(data, replaced("train-000008.video.mkv", film(4096, 4096, 8)), number=2)
    code = f"""
        import resource, sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from forging import problems
        assert not problems({str(square_data)!r}, replays=0)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        assert len(problems({str(data)!r}, replays=0)) == 3
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(result.stdout) * 1024 < 2**26


def test_a_hostile_dataset_ends_the_command_with_a_list(data):
    forge(data, replaced("train-000001.actions.npy", header((10**12, 2))))
    (data / "ind_test/shard-00000.tar").write_bytes(b"")
    result = CliRunner().invoke(main, ["data", "check", str(data), "--replays", "0"])
    assert result.exit_code == 1
    failed = [line for line in result.output.splitlines() if line.startswith("FAIL")]
    assert len(failed) == 2
    assert "2 failed" in result.stderr
    assert "ok    train/shard-00001.tar" in result.output
    assert json.loads((data / "train" / MANIFEST).read_text().splitlines()[0])["sha256"] == (
        hashlib.sha256((data / SHARD).read_bytes()).hexdigest()
    )
