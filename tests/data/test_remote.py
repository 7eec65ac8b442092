"""Datasets behind URLs: the same episodes, each shard fetched once and verified, refusals."""

import importlib.util
import os
import shutil
import signal
import subprocess
import sys

import fsspec
import numpy as np
import pytest
from click.testing import CliRunner
from conftest import PATIENCE, wait_until
from serving import served

from acwm_core.cli import main
from acwm_core.data import remote
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError, MissingExtraError

SHARDS = [f"/train/shard-0000{number}.tar" for number in range(3)]
READ = """
import sys
from acwm_core.data.dataset import EpisodeDataset
print(EpisodeDataset(sys.argv[1], "train").actions(5).sum())
"""


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv(remote.CACHE, str(tmp_path / "cache"))
    monkeypatch.setattr(remote, "WAITS", (0, 0, 0))
    return tmp_path / "cache"


@pytest.fixture
def server(square_data):
    with served(square_data) as server:
        yield server


def start_reader(url):
    command = [sys.executable, "-c", READ, url]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def files(cache):
    return [path.name for path in cache.rglob("*") if path.is_file()]


def assert_same(one, other):
    assert one.lengths == other.lengths
    assert one.checksum == other.checksum
    for index in range(len(one)):
        np.testing.assert_array_equal(one.video(index), other.video(index))
        np.testing.assert_array_equal(one.actions(index), other.actions(index))


def test_each_shard_is_fetched_once_when_it_is_first_used(server, square_data, cache):
    episodes = EpisodeDataset(server.url, "train")
    assert not set(SHARDS) & set(server.asked)
    episodes.video(5)
    assert [server.asked[shard] for shard in SHARDS] == [0, 1, 0]
    local = EpisodeDataset(square_data, "train")
    assert_same(episodes, local)
    assert_same(EpisodeDataset(server.url + "/", "train"), local)
    assert_same(EpisodeDataset(episodes.path, "train"), local)
    assert [server.asked[shard] for shard in SHARDS] == [1, 1, 1]
    assert not [name for name in files(cache) if name.endswith(".partial")]
    assert episodes.path.is_relative_to(cache)


@pytest.mark.parametrize("fault", [503, "cut", "flip"])
def test_passing_failures_are_passed_over(fault, server, square_data):
    server.faults = {"/card.yaml": [503], "/train/manifest.jsonl": [503, 500]}
    server.faults[SHARDS[1]] = [fault] * 3
    assert_same(EpisodeDataset(server.url, "train"), EpisodeDataset(square_data, "train"))
    assert server.asked[SHARDS[1]] == 4


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (503, "503"),
        ("cut", "ClientPayloadError"),
        ("flip", "another checksum than"),
    ],
)
def test_lasting_failures_end_with_a_sentence_and_leave_nothing(fault, message, server, cache):
    server.faults = {SHARDS[1]: [fault] * 10}
    episodes = EpisodeDataset(server.url, "train")
    with pytest.raises(DataError, match=rf"{server.url}{SHARDS[1]}.*{message}") as raised:
        episodes.video(5)
    assert "\n" not in str(raised.value)
    assert not {"shard-00001.tar"} & set(files(cache))
    assert not [name for name in files(cache) if name.endswith(".partial")]
    server.faults.clear()
    assert episodes.video(5).any()


@pytest.mark.ci
def test_processes_that_want_the_same_shard_fetch_it_once(server, square_data):
    server.faults = {SHARDS[1]: ["slow"]}
    readers = [start_reader(server.url) for _ in range(3)]
    said = {reader.communicate(timeout=PATIENCE)[0].strip() for reader in readers}
    assert said == {str(EpisodeDataset(square_data, "train").actions(5).sum())}
    assert server.asked[SHARDS[1]] == 1


def test_a_reader_killed_while_it_fetches_leaves_nothing_in_the_way(server, cache):
    server.faults = {SHARDS[1]: ["stalls"]}
    reader = start_reader(server.url)
    wait_until(lambda: any(name.endswith(".partial") for name in files(cache)))
    wait_until(lambda: server.asked[SHARDS[1]])
    os.kill(reader.pid, signal.SIGKILL)
    reader.communicate()
    left = [name for name in files(cache) if name.endswith(".partial")]
    assert left
    assert "shard-00001.tar" not in files(cache)
    assert EpisodeDataset(server.url, "train").actions(5).any()
    assert not [name for name in files(cache) if name.endswith(".partial")]


def test_data_that_changed_is_not_taken_for_the_old(square_data, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(square_data, folder)
    with served(folder) as server:
        before = EpisodeDataset(server.url, "ind_test")
        before.actions(0)
        lines = (folder / "train/manifest.jsonl").read_text().replace('"frames": 84', '"frames": 1')
        (folder / "train/manifest.jsonl").write_text(lines)
        after = EpisodeDataset(server.url, "ind_test")
    assert after.path != before.path
    assert EpisodeDataset(before.path, "ind_test").actions(0).any()  # fetched, so still there


def test_other_places_are_read_alike(square_data):
    memory = fsspec.filesystem("memory")
    memory.put(str(square_data), "/square", recursive=True)
    local = EpisodeDataset(square_data, "train")
    for url in ("memory://square", f"file://{square_data}"):
        assert_same(EpisodeDataset(url, "train"), local)
    memory.rm("/square", recursive=True)


@pytest.mark.parametrize(
    "url",
    [
        "pipe:touch harm",
        "pipe://touch harm",
        "simplecache::https://example.org/data",
        "filecache::pipe:touch harm",
        "ssh://host/data",
        "ftp://host/data",
        "https:example.org/data",
    ],
)
def test_what_is_no_place_of_data_is_refused(url, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(DataError, match=r"is not a supported address; URLs begin with htt"):
        EpisodeDataset(url, "train")
    done = CliRunner().invoke(main, ["data", "info", url])
    assert done.exit_code == 2
    assert "is not a supported address" in done.output
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize(("protocol", "package"), remote.PROTOCOLS.items())
def test_a_missing_package_is_named(protocol, package, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    message = rf"^{protocol}:// needs the package {package}: pip install {package}$"
    with pytest.raises(MissingExtraError, match=message):
        EpisodeDataset(f"{protocol}://place/data", "train")


def test_where_nothing_is_is_said(server, square_data):
    with pytest.raises(DataError, match=rf"there is no {server.url}/nothing/card\.yaml$"):
        EpisodeDataset(f"{server.url}/nothing", "train")
    with pytest.raises(DataError, match="has no split 'test'"):
        EpisodeDataset(server.url, "test")


def test_a_cache_that_cannot_be_written_is_said(server, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv(remote.CACHE, str(tmp_path / "file"))
    with pytest.raises(DataError, match=r"cannot write to .*file.* set ACWM_CACHE"):
        EpisodeDataset(server.url, "train")


@pytest.mark.parametrize("name", ["../../../harm.tar", "/tmp/harm.tar", "shard-00000.tar/../../x"])
def test_a_manifest_cannot_lead_out_of_the_cache(name, square_data, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(square_data, folder)
    manifest = folder / "train/manifest.jsonl"
    manifest.write_text(manifest.read_text().replace("shard-00000.tar", name))
    with served(folder) as server, pytest.raises(DataError, match=r"manifest\.jsonl is damaged"):
        EpisodeDataset(server.url, "train")


def test_a_dataset_behind_a_url_is_checked_whole(server):
    server.faults["/train/shard-00001.tar"] = ["flip"] * 9
    done = CliRunner().invoke(main, ["data", "check", server.url, "--replays", "0"])
    assert done.exit_code == 1
    wrong = [line for line in done.output.splitlines() if line.startswith("FAIL")]
    assert len(wrong) == 1
    assert "train/shard-00001.tar: cannot fetch" in wrong[0]
    server.faults.clear()
    done = CliRunner().invoke(main, ["data", "check", server.url, "--replays", "0"])
    assert done.exit_code == 0, done.output
    assert [server.asked[shard] for shard in SHARDS] == [1, 5, 1]


def test_the_command_line_takes_urls(server):
    done = CliRunner().invoke(main, ["data", "info", server.url])
    assert done.exit_code == 0, done.output
    assert "11" in done.output
    assert DatasetCard.read(remote.data_folder(server.url)).environment.name == "square"
