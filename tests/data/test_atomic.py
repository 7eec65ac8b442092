"""Files that appear whole: with the permissions that any other file gets."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from acwm_core.errors import DataError
from acwm_core.files import writing, written_whole
from acwm_core.training.run import save_weights


@pytest.fixture(params=[0o022, 0o002, 0o077])
def mode(request):
    """What the umask makes of a new file's permissions."""
    before = os.umask(request.param)
    yield 0o666 & ~request.param
    os.umask(before)


def test_weights_respect_the_umask(mode, tmp_path):
    path = tmp_path / "model.safetensors"
    save_weights(path, {"model.weight": torch.zeros(3)}, None, step=1)
    assert stat.S_IMODE(path.stat().st_mode) == mode


def test_whatever_a_library_leaves_does_too(mode, tmp_path):
    path = tmp_path / "file"
    with written_whole(path) as partial:
        partial.unlink()
        os.close(os.open(partial, os.O_CREAT | os.O_WRONLY, 0o600))
    assert stat.S_IMODE(path.stat().st_mode) == mode


DIE = """
import os, sys
from pathlib import Path
from acwm_core.files import written_whole
with written_whole(Path(sys.argv[1])) as partial:
    partial.write_text("half")
    os._exit(1)
"""


def test_what_a_killed_writer_left_is_removed_by_the_next(tmp_path):
    """But not what others that still write the file, or write other files, have begun."""
    path = tmp_path / "a[1].txt"
    for name in (path, tmp_path / "other"):
        subprocess.run([sys.executable, "-c", DIE, name], check=False)
    killed, other = sorted(tmp_path.iterdir(), key=lambda each: "other" in each.name)
    begin = killed.name.rpartition("-")[0]
    theirs = tmp_path / f"{begin}-{os.getppid()}.partial"
    elsewhere = tmp_path / ".a[1].txt.another-host-1.partial"
    for file in (theirs, elsewhere, tmp_path / f"{begin}-{'9' * 30}.partial"):
        file.touch()
    with written_whole(path) as partial:
        partial.write_text("whole")
    assert {*tmp_path.iterdir()} == {path, other, theirs, elsewhere}
    assert path.read_text() == "whole"


def test_numpys_report_of_a_full_disk_is_told_as_one():
    full = Path("/dev/full")  # every write to it fails for want of space
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    with pytest.raises(DataError, match="cannot write to"), writing(full):
        np.zeros(1_000_000).tofile(full)
