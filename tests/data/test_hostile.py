"""Datasets made to do harm: each gets one clear sentence, costs little and changes nothing.

Their checksums are right, as those of somebody with bad intentions would be.
"""

import hashlib
import io
import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner
from conftest import checksums
from forging import append, forge, npy, problems, replaced, sign, zipped

from acwm_core.cli import main
from acwm_core.data.card import MANIFEST, DatasetCard
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
    assert "allow_pickle=False" in refused(data)
    assert not mark.exists()
    np.load(io.BytesIO(npy(np.array([Attack(mark)], object))), allow_pickle=True)
    assert mark.exists()  # the attack is real


@pytest.mark.parametrize("name", ["/etc/evil", "../../evil", f"../{KEY}.json", "train-000099.json"])
def test_members_that_no_episode_has_are_found_and_never_unpacked(data, tmp_path, name):
    append(data, name=name)
    assert f"it holds '{name}' where None must be" in refused(data)
    assert not list(tmp_path.rglob("evil*"))


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"shard": "../../../etc/passwd"}, "not the name of a shard"),
        ({"shard": "/etc/passwd"}, "not the name of a shard"),
        ({"shard": "shard-00000.tar/../../x"}, "not the name of a shard"),
        ({"lengths": ["21"] * 4}, "lengths.0: Input should be a valid integer"),
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
        ("splits", {"train": "11"}),
        ("splits", []),
        ("environment.frame_size", [32]),
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


def test_a_hostile_dataset_ends_the_command_with_a_list(data):
    forge(data, replaced(f"{KEY}.actions.npy", npy(np.zeros((5, 2)))))
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
