"""Files that appear whole: with the permissions that any other file gets."""

import os
import stat

import pytest
import torch

from acwm_core.data.atomic import written_whole
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
