"""A disk that fills up: one sentence, nothing half-written, the same bytes once there is room."""

import json
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import checksums
from generating import run

HERE = Path(__file__).parent
SENTENCE = "free disk space or fix the permissions, and run the same command again to resume"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole") / "data"
    run(folder, "square", workers=0)
    return checksums(folder)


@pytest.mark.slow
def test_disks_of_many_sizes(whole, tmp_path):
    if shutil.which("unshare") is None:
        pytest.skip("this system has no unshare")
    command = ["unshare", "--map-root-user", "--mount"]
    if subprocess.run(
        [*command, "mount", "-t", "tmpfs", "tmpfs", tmp_path], check=False
    ).returncode:
        pytest.skip("this user may not mount a disk of its own")
    found = subprocess.run(
        [*command, sys.executable, str(HERE / "filling_disks.py"), str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    disks = [json.loads(line) for line in found.stdout.splitlines()]
    full = [disk for disk in disks if disk["said"]]
    assert 3 < len(full) < len(disks)
    for disk in disks:
        assert disk["whole"] == whole
    for disk in full:
        assert disk["said"].endswith(SENTENCE)
        assert "No space left on device" in disk["said"]
        shards = {name: sum_ for name, sum_ in disk["half"].items() if name.endswith(".tar")}
        assert shards.items() <= whole.items()  # none is there in part
        assert not any(name.endswith(".partial") for name in disk["half"])
    assert any(name.endswith(".tar") for disk in full for name in disk["half"])


@pytest.mark.ci
def test_files_that_may_not_grow(whole, tmp_path):
    """The same where a quota, not the disk, is the limit; with workers."""
    out = tmp_path / "data"
    program = f"""
import sys; sys.path.insert(0, {str(HERE)!r})
from generating import run
from acwm_core.errors import DataError
if __name__ == "__main__":
    try:
        run({str(out)!r}, "square")
    except DataError as error:
        print(error)
"""
    script = tmp_path / "limited.py"
    script.write_text(program)
    limit = 16_384
    found = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        text=True,
        check=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit)),
    )
    assert found.stdout.strip().endswith(SENTENCE)
    assert not list(out.rglob("*.tar"))
    assert not list(out.rglob("*.partial"))
    run(out, "square", workers=0)
    assert checksums(out) == whole
