"""The Makefile says in one sentence what is missing on a bare machine."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAKE = shutil.which("make")
pytestmark = pytest.mark.skipif(not MAKE, reason="make is not installed")


def make(*words, **environment):
    # A make around the tests would pass on its variables, such as VENV.
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    return subprocess.run(
        [str(MAKE), "--no-print-directory", *words],
        cwd=ROOT,
        env={**inherited, **environment},
        capture_output=True,
        text=True,
    )


@pytest.fixture
def bare_path(tmp_path):
    """A folder with the shell's tools but no Python."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in ("sh", "awk", "touch", "env"):
        (folder / tool).symlink_to(str(shutil.which(tool)))
    return str(folder)


def test_help_is_the_default_and_lists_every_target():
    listed = make().stdout
    for target in (
        "demo",
        "install",
        "test",
        "test-all",
        "lint",
        "types",
        "lowest",
        "site",
        "build",
        "clean",
    ):
        assert f"make {target} " in listed


def test_without_python_one_sentence_says_so(tmp_path, bare_path):
    done = make("test", f"VENV={tmp_path / 'venv'}", PATH=bare_path)
    assert done.returncode == 2
    assert "acwm needs Python 3.11, 3.12 or 3.13: install one, or name it" in done.stderr


@pytest.mark.parametrize("version", [(3, 10, 14), (3, 14, 0)])
def test_a_python_without_simulators_is_not_taken(version, tmp_path, bare_path):
    other = tmp_path / "bin" / "python3"
    other.write_text(
        f"""#!{sys.executable}
import sys
sys.version_info = {version}
exec(sys.argv[2])
"""
    )
    other.chmod(0o755)
    done = make("test", f"VENV={tmp_path / 'venv'}", PATH=bare_path)
    assert "acwm needs Python 3.11, 3.12 or 3.13" in done.stderr


def test_without_libx11_one_sentence_names_the_package(tmp_path):
    """A `.venv` whose Python cannot load the library."""
    folder = tmp_path / "venv" / "bin"
    folder.mkdir(parents=True)
    for name in ("pip", "python"):
        (folder / name).write_text("#!/bin/sh\nexit 1\n")
        (folder / name).chmod(0o755)
    done = make("demo", f"VENV={tmp_path / 'venv'}")
    assert done.returncode == 2
    assert "libX11 is missing: sudo apt-get install libx11-6" in done.stderr


def test_install_says_what_it_does_and_what_comes_next(tmp_path):
    """A `.venv` whose Python does whatever it is asked to."""
    folder = tmp_path / "venv" / "bin"
    folder.mkdir(parents=True)
    for name in ("pip", "python"):
        (folder / name).write_text("#!/bin/sh\n")
        (folder / name).chmod(0o755)
    torch, rest, done = make("install", f"VENV={tmp_path / 'venv'}").stdout.splitlines()
    assert "torch" in torch
    assert "acwm[all,dev,docs]" in rest
    assert f"source {folder}/activate" in done
    assert make("install", f"VENV={tmp_path / 'venv'}").stdout.splitlines() == [done]
