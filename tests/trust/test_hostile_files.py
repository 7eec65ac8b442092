"""Files that claim more than they hold, lead elsewhere, or are no files: one sentence each."""

import io
import os
import socket
import zipfile

import numpy as np
import pytest

from acwm_core import arrays
from acwm_core.arrays import from_npy, from_npz, load_npz, to_npy, to_npz
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import Manifest
from acwm_core.data.shards import open_shard
from acwm_core.errors import AcwmError, DataError
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.storage import load_scores
from acwm_core.files import check_fetched, check_tree, load_plain, parse_json, training_record
from acwm_core.recipe import compose
from acwm_core.training.run import read_metadata
from acwm_report.metrics_file import logged

EPISODES = "evaluation/episodes.parquet"
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"


def npy(shape, dtype="<f8", data=b""):
    """A ``.npy`` file that claims a shape."""
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    header = header.ljust(118) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


def packed(members, compression=zipfile.ZIP_DEFLATED):
    """A zip of some members."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return file.getvalue()


CLAIMS = {
    "10^15 numbers": npy((10**15,)),
    "10^15 numbers by two axes": npy((10**8, 10**7), "<f4", bytes(64)),
    "one number more": npy((9,), "<f8", bytes(64)),
    "a negative axis": npy((-1, 4), "<f8", bytes(64)),
    "10^15 empty texts": npy((10**15,), "<U0"),
    "objects": npy((4,), "|O", bytes(64)),
    "an axis beyond 64 bits": npy((2**70, 0)),
    "nested brackets": b"\x93NUMPY\x01\x00\x00\x20" + b"(" * 8192,
    "many signs": b"\x93NUMPY\x01\x00\x00\x20" + b"-" * 8191 + b"1",
    "structures": npy((1,), "<f8").replace(b"'<f8'", b"[('a', '<f8')]"),
}


@pytest.mark.parametrize("data", CLAIMS.values(), ids=CLAIMS)
def test_arrays_hold_what_their_header_claims(data):
    with pytest.raises(ValueError, match=r"claims|damaged|plain"):
        from_npy(data)
    with pytest.raises(ValueError, match=r"claims|damaged|plain"):
        from_npz(packed([("a.npy", data)]))


def test_an_archive_of_arrays_is_no_bomb(tmp_path, monkeypatch):
    monkeypatch.setattr(arrays, "LARGE", large := 2**20)
    for members, problem in (
        ([("a.npy", npy((2, large), "|u1", bytes(2 * large)))], "claim to hold"),
        ([(f"{i}.npy", npy((large // 4,), "|u1", bytes(large // 4))) for i in range(5)], "claim"),
        ([("a.txt", b"hello")], "a.txt is no array"),
        ([("a.npy", b"hello")], "magic"),
        ([("a.npy", to_npy(np.zeros(3)) + b"more")], "more than its header says"),
    ):
        path = tmp_path / "arrays.npz"
        path.write_bytes(packed(members))
        with pytest.raises(ValueError, match=problem):
            load_npz(path)
    twice = packed([("a.npy", to_npy(np.zeros(3)))]).replace(b"a.npy", b"b.npy")
    np.testing.assert_array_equal(from_npz(twice)["b"], np.zeros(3))  # the checks are no broader
    with pytest.warns(UserWarning, match="Duplicate"):
        twice = packed([("a.npy", to_npy(np.zeros(3)))] * 2)
    with pytest.raises(ValueError, match="twice"):
        from_npz(twice)


def test_arrays_are_read_as_numpy_does():
    stored = {"a": np.arange(6, dtype=np.float16).reshape(2, 3), "b": np.array(["x", "yy"])}
    for data in (to_npz(stored), packed([(f"{n}.npy", to_npy(a)) for n, a in stored.items()])):
        found, expected = from_npz(data), np.load(io.BytesIO(data))
        assert list(found) == list(expected)
        for name, array in found.items():
            np.testing.assert_array_equal(array, expected[name])


@pytest.mark.parametrize("text", ["[" * 10**5 + "]" * 10**5, '{"a":' * 10**5, "[" * 10**6])
def test_deep_json_is_refused(text):
    with pytest.raises(ValueError, match=r"nested too deeply|Expecting"):
        parse_json(text)


def test_links_stay_in_the_folder(tmp_path):
    root, outside = tmp_path / "takes", tmp_path / "outside"
    (root / "one").mkdir(parents=True)
    outside.mkdir()
    for path in (root / "one/a.txt", outside / "b.txt"):
        path.write_text("text")
    (root / "within.txt").symlink_to("one/a.txt")
    (root / "circle").symlink_to(root)
    (root / "circle 2").symlink_to("circle 2")
    (root / "nothing").symlink_to("nowhere")
    (tmp_path / "takes 2").symlink_to(root)
    check_tree(root)
    check_tree(tmp_path / "takes 2")
    for link, target in (("b.txt", outside / "b.txt"), ("below", outside), ("up", "../../outside")):
        (root / "one" / link).symlink_to(target)
        with pytest.raises(DataError, match=f"{link} is a link that leads out of"):
            check_tree(tmp_path / "takes 2")
        check_tree(root, follow_links=True)
        (root / "one" / link).unlink()
    (root / "one/below").symlink_to(outside)
    os.mkfifo(outside / "pipe")
    with pytest.raises(DataError, match="pipe is not a file"):
        check_tree(root, follow_links=True)


@pytest.mark.parametrize("kind", ["pipe", "socket", "device", "link to a pipe"])
def test_what_is_no_file_is_named(tmp_path, kind):
    path = tmp_path / "takes" / "0.png"
    path.parent.mkdir()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        socket.socket(socket.AF_UNIX).bind(str(path))
    elif kind == "device":
        path.symlink_to("/dev/zero")
    else:
        os.mkfifo(path.with_name("1.png"))
        path.symlink_to("1.png")
    with pytest.raises(DataError, match=r"\.png is not a file"):
        check_tree(path.parent, follow_links=True)
    with pytest.raises(DataError, match=r"is not a file"):
        check_tree(path)


def test_a_pointer_of_git_lfs_is_named(tmp_path):
    path = tmp_path / "info.json"
    path.write_bytes(POINTER)
    with pytest.raises(DataError, match=r"info\.json is a pointer of Git LFS.*git lfs pull"):
        check_fetched(path)
    for read in (load_plain, read_metadata, open_shard):
        with pytest.raises(DataError, match=r"pointer of Git LFS"):
            read(path)
    path.write_bytes(b"{}")
    check_fetched(path)
    check_fetched(tmp_path / "missing")


@pytest.mark.parametrize(
    ("name", "read"),
    [
        ("card.yaml", DatasetCard.read),
        ("manifest.jsonl", Manifest),
        ("recipe.yaml", lambda folder: compose(folder / "recipe.yaml", [])),
        ("evaluation/summary.json", Summary.read),
        ("evaluation/episodes.parquet", lambda folder: load_scores(folder / EPISODES)),
        ("metrics.csv", lambda folder: logged(folder, "loss")),
        ("estimator.safetensors", lambda folder: training_record(folder / "estimator.safetensors")),
    ],
)
def test_a_pointer_in_the_place_of_any_file_of_a_dataset_or_run(tmp_path, name, read):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_bytes(POINTER)
    with pytest.raises(AcwmError, match=r"pointer of Git LFS .*: run `git lfs pull` there$"):
        read(tmp_path)
