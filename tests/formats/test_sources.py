"""Recordings behind a URL: fetched once, continued after a failure, refused in one sentence."""

import fsspec
import pytest

from acwm_core.data import remote
from acwm_core.errors import DataError
from acwm_formats.sources import fetched, is_url

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
    paths = (path for path in place.rglob("*") if path.is_file())
    return {path.relative_to(place).as_posix(): path.read_bytes() for path in paths}


def test_a_folder_is_fetched_once(folder, monkeypatch):
    place = fetched("memory://takes/", progress=False)
    assert place.name == "takes"
    assert contents(place) == FILES
    monkeypatch.setattr(remote, "fetch", None)
    assert fetched("memory://takes", progress=False) == place


def test_a_file(folder):
    place = fetched("memory://takes/a.csv", progress=False)
    assert (place.name, place.read_bytes()) == ("a.csv", b"x\n1\n")


def test_a_folder_that_has_changed_is_another(folder):
    before = fetched("memory://takes", progress=False)
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
