"""Generation that is killed: nothing half-written, no worker left, the same bytes in the end."""

import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import PATIENCE, checksums, wait_until
from generating import run

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "data"
    run(folder, workers=0)
    return checksums(folder)


def launch(out, *, gated=False):
    """A generating process; one that is gated makes no more than its first episodes."""
    gate = out.with_name("gate")
    gate.unlink(missing_ok=True)
    if gated:
        gate.touch()
    return subprocess.Popen(
        [sys.executable, str(HERE / "generating.py"), str(out)],
        env={**os.environ, "PYTHONPATH": str(HERE), "SQUARE_GATE": str(gate)},
        stderr=subprocess.PIPE,
        text=True,
    )


def start(out):
    """A generating process that has finished a shard or two, and cannot come to its end."""
    process, manifest = launch(out, gated=True), out / "train/manifest.jsonl"
    wait_until(lambda: manifest.exists() and manifest.read_text().count("\n"), process)
    return process


def children(pid):
    paths = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for path in paths for child in path.read_text().split()]


def workers_of(pid):
    """The worker processes of `pid`, which are children of its server."""
    commands = {child: Path(f"/proc/{child}/cmdline").read_bytes() for child in children(pid)}
    servers = [child for child, command in commands.items() if b"forkserver" in command]
    return [worker for server in servers for worker in children(server)]


def alive(pid):
    state = Path(f"/proc/{pid}/stat")
    return state.exists() and state.read_text().rpartition(")")[2].split()[0] != "Z"


@pytest.mark.skipif(sys.platform != "linux", reason="watches processes in /proc")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.ci
def test_a_killed_command_goes_on_where_it_ended(tmp_path, uninterrupted, how):
    out = tmp_path / "data"
    process = start(out)
    workers = workers_of(process.pid)
    assert len(workers) == 2
    process.send_signal(how)
    process.communicate(timeout=PATIENCE)
    wait_until(lambda: not any(alive(pid) for pid in workers))  # they don't outlive the command
    finished = {p.relative_to(out): p.stat().st_ino for p in out.rglob("*.tar")}
    assert 0 < len(finished) < 8
    for path in finished:
        assert checksums(out)[str(path)] == uninterrupted[str(path)]

    run(out, workers=0)
    assert checksums(out) == uninterrupted
    assert all((out / path).stat().st_ino == inode for path, inode in finished.items())
    assert not list(out.rglob("*.partial"))


@pytest.mark.slow
def test_killed_at_any_moment_it_makes_nothing_twice(tmp_path, uninterrupted):
    """The same command, killed again and again wherever it happens to be, until it gets through."""
    out, rng = tmp_path / "data", random.Random(0)
    made, kills = {}, 0
    while True:
        process = launch(out, gated=not made)
        if not made:
            wait_until(lambda: any(out.rglob("shard-*.tar")), process)
        try:
            moment = rng.uniform(0.5, 2) if kills < 4 else PATIENCE
            _, complaint = process.communicate(timeout=moment if made else 0)
            assert process.returncode == 0, complaint
            break
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            kills += 1
        now = {p.relative_to(out): p.stat().st_ino for p in out.rglob("shard-*.tar")}
        assert made.items() <= now.items()  # what was finished stays, and is not made anew
        assert all(checksums(out)[str(path)] == uninterrupted[str(path)] for path in now)
        made = now
    assert kills
    assert checksums(out) == uninterrupted


@pytest.mark.skipif(sys.platform != "linux", reason="watches processes in /proc")
@pytest.mark.ci
def test_a_killed_worker_is_told_and_the_command_goes_on(tmp_path, uninterrupted):
    out = tmp_path / "data"
    process = start(out)
    os.kill(workers_of(process.pid)[0], signal.SIGKILL)
    _, complaint = process.communicate(timeout=PATIENCE)
    assert process.returncode != 0
    assert "a worker process died, perhaps out of memory" in complaint
    run(out, workers=0)
    assert checksums(out) == uninterrupted
