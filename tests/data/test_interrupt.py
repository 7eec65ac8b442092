"""Generation that is killed: nothing half-written, no worker left, the same bytes in the end."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import checksums
from generating import run

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "data"
    run(folder)
    return checksums(folder)


def start(out):
    """A generating process, once it has finished a shard or two."""
    environment = {**os.environ, "PYTHONPATH": str(HERE)}
    process = subprocess.Popen(
        [sys.executable, str(HERE / "generating.py"), str(out)],
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
    )
    manifest = out / "train/manifest.jsonl"
    deadline = time.monotonic() + 60
    while not (manifest.exists() and manifest.read_text().count("\n")):
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return process


def children(pid):
    """The worker processes of `pid`; its resource tracker ends by itself."""
    listed = [
        c for path in Path(f"/proc/{pid}/task").glob("*/children") for c in path.read_text().split()
    ]
    return [int(c) for c in listed if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]


def alive(pid):
    state = Path(f"/proc/{pid}/stat")
    return state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="watches processes in /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_command_goes_on_where_it_ended(tmp_path, uninterrupted, how):
    out = tmp_path / "data"
    process = start(out)
    workers = children(process.pid)
    assert len(workers) == 2
    process.send_signal(how)
    process.wait(timeout=20)
    deadline = time.monotonic() + 20
    while any(alive(pid) for pid in workers):
        assert time.monotonic() < deadline, "the workers outlive the command"
        time.sleep(0.02)

    finished = {p.relative_to(out): p.stat().st_ino for p in out.rglob("*.tar")}
    assert 0 < len(finished) < 8
    for path in finished:
        assert checksums(out)[str(path)] == uninterrupted[str(path)]

    run(out)
    assert checksums(out) == uninterrupted
    assert all((out / path).stat().st_ino == inode for path, inode in finished.items())
    assert not list(out.rglob("*.partial"))
