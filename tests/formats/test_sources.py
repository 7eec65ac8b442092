"""Recordings behind a URL: fetched once, continued after a failure, refused in one sentence."""

import hashlib
import http.server
import json
import shutil
import threading
from pathlib import Path
from urllib.parse import parse_qs, unquote

import fsspec
import numpy as np
import pyarrow.parquet
import pytest
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data import remote
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_formats.sources import fetched, is_url, present
from tests.data.serving import served
from tests.formats.corpus import files
from tests.formats.corpus.cases import Case, three
from tests.formats.test_from_lerobot import REFERENCE

FILES = {"a.mp4": b"first", "a.csv": b"x\n1\n", "deeper/ü 1.txt": b"third"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv(remote.CACHE, str(tmp_path / "cache"))
    monkeypatch.setattr(remote, "WAITS", ())
    memory = fsspec.filesystem("memory")
    memory.pipe({f"/takes/{name}": data for name, data in FILES.items()})
    yield memory
    memory.rm("/takes", recursive=True)


def contents(place):
    """The files, after what is promised was asked for."""
    paths = [path for path in place.rglob("*") if path.is_file() and path.name[0] != "."]
    for path in paths:
        present(path)
    return {path.relative_to(place).as_posix(): path.read_bytes() for path in paths}


def test_a_folder_is_fetched_once(folder, monkeypatch):
    place = fetched("memory://takes/", progress=False)
    assert place.name == "takes"
    assert (place / "a.mp4").read_bytes() == bytes(5)  # its place is held until it is read
    assert contents(place) == FILES
    monkeypatch.setattr(remote, "fetch", None)
    assert fetched("memory://takes", progress=False) == place


def test_a_file(folder):
    place = fetched("memory://takes/a.csv", progress=False)
    assert (place.name, place.read_bytes()) == ("a.csv", b"x\n1\n")


def test_a_folder_that_has_changed_is_another(folder):
    before = fetched("memory://takes", progress=False)
    contents(before)
    folder.pipe("/takes/a.mp4", b"another")
    after = fetched("memory://takes", progress=False)
    assert contents(after)["a.mp4"] == b"another"
    assert contents(before) == FILES


def test_it_continues_where_it_failed(folder, monkeypatch):
    fetch, asked = remote.fetch, []

    def failing(url, path):
        asked.append(url)
        if "a.csv" in url and asked.count(url) == 1:
            raise DataError("the line is dead")
        fetch(url, path)

    monkeypatch.setattr(remote, "fetch", failing)
    with pytest.raises(DataError, match="dead"):
        fetched("memory://takes", progress=False)
    assert contents(fetched("memory://takes", progress=False)) == FILES
    assert asked.count("memory://takes/a.csv") == 2


def test_a_video_that_changed_or_broke_off_is_not_taken(folder, monkeypatch):
    place = fetched("memory://takes", progress=False)
    with monkeypatch.context() as cut:
        cut.setattr(type(folder), "get_file", cut_off)
        with pytest.raises(KeyboardInterrupt):
            present(place / "a.mp4")
    assert (place / "a.mp4").stat().st_mtime == 0
    folder.pipe("/takes/a.mp4", b"longer than before")
    with pytest.raises(DataError, match="has changed"):
        present(place / "a.mp4")


def cut_off(system, name, path):
    Path(path).write_bytes(b"fir")
    raise KeyboardInterrupt


class Hub(http.server.BaseHTTPRequestHandler):
    """The dataset org/arm as huggingface.co serves it: revision, tree, paths, and files."""

    def log_message(self, *_):
        pass

    def reply(self, body, status=200, **headers):
        self.send_response(status)
        for name, value in {**headers, "Content-Length": str(len(body))}.items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def listed(self, folder, deep):
        root = self.server.folder
        for path in sorted((root / folder).rglob("*") if deep else (root / folder).iterdir()):
            name, oid = path.relative_to(root).as_posix(), hashlib.sha1(str(path).encode())
            kind = {"type": "directory"} if path.is_dir() else {"type": "file"}
            size = 0 if path.is_dir() else path.stat().st_size
            yield {**kind, "path": name, "oid": oid.hexdigest(), "size": size}

    def do_GET(self):
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0)).decode()
        path, _, query = unquote(self.path).partition("?")
        api, sha = "/api/datasets/org/arm", "0123456789" * 4
        self.server.asked.append(path)
        if path == api or path.startswith(f"{api}/revision/"):
            self.reply(json.dumps({"id": "org/arm", "sha": sha, "siblings": []}).encode())
        elif path.startswith(f"{api}/tree/"):
            inner = path.removeprefix(f"{api}/tree/").partition("/")[2]
            found = list(self.listed(inner, "recursive=True" in query or "recursive=true" in query))
            self.reply(json.dumps(found).encode())
        elif path.startswith(f"{api}/paths-info/"):
            names = json.loads(body)["paths"] if body[0] == "{" else parse_qs(body)["paths"]
            found = [each for each in self.listed("", True) if each["path"] in names]
            self.reply(json.dumps(found).encode())
        elif path.startswith("/datasets/org/arm/resolve/"):
            name = path.removeprefix("/datasets/org/arm/resolve/").partition("/")[2]
            self.reply(
                (self.server.folder / name).read_bytes(), ETag=f'"{name}"', X_Repo_Commit=sha
            )
        else:
            self.reply(b"", 404)

    do_HEAD = do_POST = do_GET


def two_cameras(folder):
    """A copy of the library's dataset, with a second camera that shows the same."""
    shutil.copytree(REFERENCE / "video", folder)
    top, wrist = "observation.images.top", "observation.images.wrist"
    shutil.copytree(folder / "videos" / top, folder / "videos" / wrist)
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"][wrist] = info["features"][top]
    (folder / "meta/info.json").write_text(json.dumps(info))
    path = folder / "meta/episodes/chunk-000/file-000.parquet"
    table = pyarrow.parquet.read_table(path)
    for name in [name for name in table.column_names if name.startswith(f"videos/{top}")]:
        table = table.append_column(name.replace(top, wrist), table[name])
    pyarrow.parquet.write_table(table, path)
    return folder


@pytest.fixture
def hub(tmp_path, monkeypatch):
    from huggingface_hub import HfFileSystem, constants

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    server.folder, server.asked = two_cameras(tmp_path / "arm"), []
    threading.Thread(target=server.serve_forever, daemon=True).start()
    here = f"http://127.0.0.1:{server.server_port}"  # as HF_ENDPOINT would have it
    template = constants.HUGGINGFACE_CO_URL_TEMPLATE.replace(constants.ENDPOINT, here)
    monkeypatch.setattr(constants, "ENDPOINT", here)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
    monkeypatch.setenv(remote.CACHE, str(tmp_path / "cache"))
    HfFileSystem.clear_instance_cache()
    yield server
    HfFileSystem.clear_instance_cache()
    server.shutdown()
    server.server_close()


def test_a_dataset_of_the_hub_needs_the_videos_of_its_camera(hub, tmp_path):
    asked = ["--camera", "observation.images.wrist", "--size", "24x32", "--test-episodes", "1"]
    made = []
    for source, out in (("hf://datasets/org/arm", "data"), (hub.folder, "local")):
        words = ["data", "import", str(source), *asked, "--workers", "0", "--out"]
        done = CliRunner().invoke(main, [*words, str(tmp_path / out)])
        assert done.exit_code == 0, done.output
        made.append(EpisodeDataset(tmp_path / out, "train")[0])
    np.testing.assert_array_equal(made[0].video, made[1].video)
    np.testing.assert_array_equal(made[0].actions, made[1].actions)
    films = {path for path in hub.asked if path.endswith(".mp4")}
    assert {path.split("/")[-3] for path in films} == {"observation.images.wrist"}


def test_a_folder_of_videos_on_the_web(tmp_path, monkeypatch):
    monkeypatch.setenv(remote.CACHE, str(tmp_path / "cache"))
    for name in ("web/takes", "out"):
        (tmp_path / name).mkdir(parents=True)
    files.videos(tmp_path / "web/takes", Case("good", three()))
    with served(tmp_path / "web") as server:
        words = ["data", "import", f"{server.url}/takes", "--test-episodes", "1", "--workers", "0"]
        for out in ("one", "two"):
            done = CliRunner().invoke(main, [*words, "--out", str(tmp_path / out)])
            assert done.exit_code == 0, done.output
        asked = {name: count for name, count in server.asked.items() if name.endswith(".mp4")}
    assert len(asked) == 3
    assert set(asked.values()) == {1}
    assert DatasetCard.read(tmp_path / "one").splits == {"train": 2, "ind_test": 1}


@pytest.mark.parametrize(
    ("url", "problem"),
    [("memory://nothing", "there is nothing"), ("ftp://host/x", "not a supported address")],
)
def test_what_is_refused(folder, url, problem):
    with pytest.raises(DataError, match=problem):
        fetched(url, progress=False)


def test_what_a_url_is(tmp_path):
    assert is_url("hf://datasets/ORG/NAME")
    assert not is_url("acwm:acwm/push_cube-v0")
    assert not is_url("C:/recordings")
