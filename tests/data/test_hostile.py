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
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from conftest import checksums
from forging import append, claims, film, forge, npy, problems, replaced, sign, zipped

from acwm_core.cli import main
from acwm_core.data.card import DatasetCard
from acwm_core.data.manifest import MANIFEST
from acwm_core.data.shards import MAX_JSON, open_shard
from acwm_core.data.video import encode_video
from acwm_core.errors import DataError
from tests.plugins import Attack

SHARD = "train/shard-00000.tar"
KEY = "train-000001"
SIZE = (32, 32)


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


@pytest.mark.parametrize("member", ["actions.npy", "contacts.npy", "states.npz"])
def test_pickles_are_never_loaded(data, tmp_path, member):
    mark = tmp_path / "mark"
    attack = npy(np.array([Attack(mark)], object))
    if member == "states.npz":
        attack = zipped({"position.npy": attack})
    forge(data, replaced(f"{KEY}.{member}", attack))
    assert "pickled" in refused(data)
    assert not mark.exists()
    np.load(io.BytesIO(npy(np.array([Attack(mark)], object))), allow_pickle=True)
    assert mark.exists()  # the attack is real


FOREIGN, LINK, CUT = (
    "not part of an episode",
    "a link or another special",
    "cut off: it ends within",
)


@pytest.mark.parametrize(
    ("header", "reason"),
    [
        *(
            ({"name": name}, FOREIGN)
            for name in ("/etc/evil", "../../evil", "a/../../../evil", "evil.sh", f"/{KEY}.json")
        ),
        *(({"name": name}, FOREIGN) for name in (f"../{KEY}.json", f"x/../../{KEY}.json")),
        *(({"name": name}, FOREIGN) for name in (f"{KEY}.sh", f"{KEY}.extra")),
        ({"type": tarfile.SYMTYPE, "linkname": "/etc/passwd"}, LINK),
        ({"type": tarfile.LNKTYPE, "linkname": "x"}, LINK),
        *(({"type": kind}, LINK) for kind in (tarfile.FIFOTYPE, tarfile.CHRTYPE, tarfile.DIRTYPE)),
        ({"type": tarfile.GNUTYPE_SPARSE}, LINK),
        ({"name": "././@PaxHeader", "type": tarfile.XHDTYPE, "size": 2**40}, "not part of"),
        ({"name": "././@LongLink", "type": tarfile.GNUTYPE_LONGNAME, "size": 2**40}, "not part of"),
        *(({"size": size}, CUT) for size in (2**33 - 1, 2**33, 2**62, 2**70, -512)),
        ({"name": f"{KEY}.json"}, rf"holds {KEY}.json twice"),
        ({}, "it holds 'train-000099.json' where None must be"),
    ],
)
def test_members_that_no_episode_has_are_refused(data, tmp_path, header, reason):
    append(data, **{"name": "train-000099.json", **header})
    assert reason in refused(data)
    assert not list(tmp_path.rglob("evil*"))
    if header:
        with pytest.raises(DataError, match=r"shard-00000\.tar is damaged \("):
            open_shard(data / SHARD)


def lies():
    """Members that a shard of ours never holds, and what is said of them."""
    numbers = npy(np.zeros((21, 2), np.float32))
    noise = npy(np.random.default_rng(0).normal(size=(21, 2)))
    objects = npy(np.array([print], object))
    actions, states, about = "actions.npy", "states.npz", "json"
    yield actions, claims((2**40, 2)), "claims float32"
    yield actions, claims((10**6, 2), data=bytes(64)), "claims float32"
    yield actions, claims((-1, 2)), "actions.npy of episode 1"
    yield actions, claims((2**62, 2**62)), "actions.npy of episode 1"
    yield actions, npy(np.zeros((21, 2))), "it is float64"
    yield actions, npy(np.zeros(42, np.float32)), "it is float32 (42,)"
    yield actions, npy(np.array(["x"])), "not numbers"
    yield actions, objects, "pickled objects"
    yield actions, b"\x93NUMPY\x02\x00" + numbers[8:], "version"
    yield actions, b"\x93NUMPY\x02\x00" + (2**32 - 1).to_bytes(4, "little"), "version"
    yield actions, b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 60000, "actions.npy of episode 1"
    yield actions, b"", "actions.npy of episode 1"
    yield "contacts.npy", claims((10**11, 3), "<i4"), "claims int32"
    yield "contacts.npy", npy(np.zeros((3, 3))), "it is float64"
    yield states, zipped({"position.npy": claims((10**12, 2), "<f8")}), "claims float64"
    yield states, zipped({"position.npy": bytes(2**28)}, zipfile.ZIP_DEFLATED), "claims more"
    yield states, zipped({"position.npy": noise}, zipfile.ZIP_DEFLATED), "compressed"
    yield states, zipped({"position.npy": objects}), "pickled"
    yield states, zipped({"position.npy": npy(np.zeros((5, 2)))}), "has 5 rows"
    yield states, b"PK" + bytes(100), "states.npz of episode 1"
    yield about, b'{"spec": ' + b"[" * 100_000, "json of episode 1"
    yield about, b"[]", "not a JSON object"
    yield about, b'{"crc32": []}', "not a JSON object"
    yield about, b'{"crc32": 3, "spec": {}, "factors": 1, "versions": 3}', "not a JSON object"
    yield about, b'{"crc32": {}, "spec": {"environment": "square", "evil": 1}}', "json of episode 1"
    yield about, b'{"x": "' + b"a" * MAX_JSON + b'"}', f"it has {MAX_JSON + 9} bytes"
    for member in ("video.mkv", "mask.mkv"):
        yield member, film(4096, 4096), "its frames are 4096×4096, not 32×32"
        yield member, film(32, 40), "its frames are 32×40"
        yield member, film(32, 32, frames=3000), "more than 21 frames"
        yield member, b"#EXTM3U\n/etc/x", "it cannot be decoded"
    large = encode_video(np.zeros((21, 512, 512, 3), np.uint8))
    for field in (b"\xb0", b"\xba"):  # Matroska's PixelWidth and PixelHeight, of two bytes each
        assert large.count(field + b"\x82\x02\x00") == 1
        large = large.replace(field + b"\x82\x02\x00", field + b"\x82\x00\x20")
    yield "video.mkv", large, "its frames are 512×512, not 32×32"  # the container says 32×32


LIES = [*lies()]


@pytest.mark.parametrize(("member", "content", "reason"), LIES)
def test_members_that_lie_about_themselves_are_refused(data, member, content, reason):
    forge(data, replaced(f"{KEY}.{member}", content))
    assert reason in refused(data)
    with pytest.raises(DataError) as raised:
        open_shard(data / SHARD).episode(1, SIZE)
    assert f"shard {data / SHARD} is damaged (" in str(raised.value)
    assert reason in str(raised.value)
    assert "\n" not in str(raised.value)


def test_states_under_names_that_lead_out_are_refused(data):
    states = zipped({"../position.npy": npy(np.zeros((21, 2)))})
    for content in (states, b"PK\x05\x06" + bytes(18)):
        forge(data, replaced(f"{KEY}.states.npz", content))
        assert "the state fields are" in refused(data)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"shard": "../../../etc/passwd"}, "not the name of a shard"),
        ({"shard": "/etc/passwd"}, "not the name of a shard"),
        ({"shard": "shard-00000.tar/../../x"}, "not the name of a shard"),
        ({"lengths": []}, "impossible counts"),
        ({"lengths": ["21"] * 4}, "lengths.0: Input should be a valid integer"),
        ({"lengths": [10**12] * 4}, "frames are more than 134217728"),
        ({"size": -1}, "impossible counts"),
        ({"first": None}, "first: Input should be a valid integer"),
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
    with pytest.raises(DataError, match="is a link that leads out of"):
        problems(data, replays=0)
    shard.unlink()
    shard.mkdir()
    assert "missing" in refused(data)
    shard.rmdir()
    os.mkfifo(shard)
    with pytest.raises(DataError, match="is not a regular file"):
        problems(data, replays=0)


def changed(card, name, value):
    """A card as text, another value under a dotted name."""
    *path, last = name.split(".")
    place = card
    for key in path:
        place = place[key]
    place[last] = value
    return yaml.safe_dump(card)


BOMB = "a0: &a0 [x, x, x]\n" + "".join(
    f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]\n" for i in range(1, 30)
)


@pytest.mark.parametrize(
    "change",
    [
        ("splits", {"../../etc": 3}),
        ("splits", {"train": -1}),
        ("splits", {"train": "11"}),
        ("splits", []),
        ("shard_episodes", 0),
        ("environment.frame_size", [10**9, 10**9]),
        ("environment.frame_size", [32]),
        ("environment.fps", 0),
        ("environment.horizon", "21"),
        ("environment.action.low", [3.0, 3.0]),
        ("environment.evil", 1),
        lambda card: BOMB + yaml.safe_dump(card),
        lambda card: "!!python/object/apply:os.system ['touch /tmp/acwm-evil']",
        lambda card: "[" * 100000,
        lambda card: "x: " + "y" * 2**23,
        lambda card: "\0\1\2",
        *(lambda card, text=text: text for text in ("", "just text", "a: [", "format: 1")),
    ],
)
def test_cards_that_mislead_are_refused(data, change):
    card = yaml.safe_load((data / "card.yaml").read_text())
    text = change(card) if callable(change) else changed(card, *change)
    (data / "card.yaml").write_text(text)
    with pytest.raises(DataError, match="is not a dataset card") as raised:
        DatasetCard.read(data)
    assert "\n" not in str(raised.value)
    result = CliRunner().invoke(main, ["data", "check", str(data)])
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert not Path("/tmp/acwm-evil").exists()


HUNGRY = f"""
import resource, sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from forging import problems
assert not problems(sys.argv[1], replays=0)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for folder in sys.argv[2:]:
    assert len(problems(folder, replays=0)) == 1, folder
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def test_bombs_cost_no_memory(square_data, tmp_path):
    """They are found by what they claim: a process that checks all grows by less than 40 MB."""
    bombs = [*LIES, ("video.mkv", film(8192, 8192, frames=1), "")]
    folders = [tmp_path / str(number) for number in range(len(bombs))]
    for folder, (member, content, _) in zip(folders, bombs, strict=True):
        for name in ("card.yaml", SHARD, f"train/{MANIFEST}"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(square_data / name, folder / name)
        only_this(folder)
        forge(folder, replaced(f"{KEY}.{member}", content))
    command = [sys.executable, "-c", HUNGRY, square_data, *folders]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) < 40_000  # kB; one frame of the largest takes 200 MB


def only_this(folder):
    """Have card and manifest say that the first shard of `train` is all there is."""
    manifest = folder / "train" / MANIFEST
    manifest.write_text(manifest.read_text().partition("\n")[0] + "\n")
    card = yaml.safe_load((folder / "card.yaml").read_text())
    (folder / "card.yaml").write_text(yaml.safe_dump({**card, "splits": {"train": 4}}))


def test_a_hostile_dataset_ends_the_command_with_a_list(data):
    forge(data, replaced(f"{KEY}.actions.npy", claims((10**12, 2))))
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
