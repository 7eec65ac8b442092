"""Simulators give the same bytes whatever the shell says, each shell in a process of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.ci

SCRIPT = Path(__file__).with_name("drawing_worlds.py")
WORLDS = ("reacher", "push_rope", "stack_cube")
"""MuJoCo, Taichi and PyBullet; all are drawn by Taichi."""

SHELL = {
    # of Taichi
    "TI_ADVANCED_OPTIMIZATION": "0",
    "TI_ARCH": "vulkan",
    "TI_DEBUG": "1",
    "TI_DEFAULT_FP": "64",
    "TI_FAST_MATH": "0",
    "TI_LOG_LEVEL": "trace",
    "TI_MAX_BLOCK_DIM": "banana",
    "ENABLE_TAICHI_HEADER_PRINT": "1",
    # of OpenGL
    "DISPLAY": ":77",
    "LIBGL_ALWAYS_INDIRECT": "1",
    "MUJOCO_GL": "osmesa",
    "PYOPENGL_PLATFORM": "banana",
    # of arithmetic
    "MKL_NUM_THREADS": "3",
    "OMP_DYNAMIC": "true",
    "OMP_NUM_THREADS": "3",
    "OMP_PROC_BIND": "spread",
    "OPENBLAS_NUM_THREADS": "3",
    # of Python
    "LANG": "C",
    "LC_ALL": "C",
    "PYTHONCOERCECLOCALE": "0",
    "PYTHONHASHSEED": "7",
    "PYTHONOPTIMIZE": "2",
    "PYTHONUTF8": "0",
    "PYTHONWARNINGS": "error",
    "TZ": "Asia/Kathmandu",
}
"""Variables that change what libraries compute, or how."""


KERNEL = """
from acwm_sim import engine

@engine.ti.kernel
def triple(x: float) -> float:
    return 3 * x
"""
TRIPLED = "from kernel import engine, triple; engine.start(); print(triple(2.0))"


def said_by(script, folder, *words, **variables):
    """What a script writes to stdout, and to stderr."""
    done = subprocess.run(
        [sys.executable, str(script), *words],
        cwd=folder,
        env={name: v for name, v in {**os.environ, **variables}.items() if v is not None},
        capture_output=True,
        text=True,
        timeout=900,
        umask=0o077,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout, done.stderr


def drawn(folder, worlds=WORLDS, **variables):
    """The digest of each world, and what was said about it."""
    digests, said = said_by(SCRIPT, folder, *worlds, **variables)
    return dict(line.split() for line in digests.splitlines()), said


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    digests, said = drawn(tmp_path_factory.mktemp("usual"))
    assert [*digests] == [*WORLDS]
    assert said == ""
    return digests


def test_variables(usual, tmp_path):
    folder = tmp_path / "große Übung"
    folder.mkdir()
    assert drawn(folder, **SHELL) == (usual, "")


def test_a_home_that_nothing_can_be_written_to(tmp_path):
    home = tmp_path / "file"
    home.touch()
    (tmp_path / "kernel.py").write_text(KERNEL)
    (script := tmp_path / "tripled.py").write_text(TRIPLED)
    (temporary := tmp_path / "temporary").mkdir()
    folders = {"HOME": str(home), "XDG_CACHE_HOME": str(home / "cache"), "TMPDIR": str(temporary)}
    folders["ACWM_CACHE"] = None
    assert said_by(script, tmp_path, **folders) == ("6.0\n", "")
    assert [*temporary.glob("acwm-*/taichi/*")]  # compiled kernels are kept there
    folders["TI_OFFLINE_CACHE_FILE_PATH"] = str(home / "kernels")
    (other := tmp_path / "other").mkdir()
    result, said = said_by(script, tmp_path, **{**folders, "TMPDIR": str(other)})
    assert result == "6.0\n"
    assert "set TI_OFFLINE_CACHE_FILE_PATH to another folder" in said
    assert "Traceback" not in said
    assert not [*other.glob("acwm-*/*")]


def test_no_home_at_all(usual, tmp_path):
    """As in a container whose user has no account."""
    folders = {"HOME": None, "XDG_CACHE_HOME": None, "TMPDIR": str(tmp_path), "ACWM_CACHE": None}
    digests, said = drawn(tmp_path, ["reacher"], **folders)
    assert (digests["reacher"], said) == (usual["reacher"], "")
