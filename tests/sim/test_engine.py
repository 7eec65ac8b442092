"""The guarded start of Taichi, in processes of its own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


def run(code, **env):
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, **env},
        timeout=600,
    )


def test_starting_twice_is_harmless_and_silent():
    result = run("from acwm_sim import engine; engine.start(); engine.start()")
    assert result.returncode == 0
    assert result.stdout == ""


@pytest.mark.parametrize(
    ("how", "advice"),
    [
        (
            "t = threading.Thread(target=tried); t.start(); t.join()",
            "processes (spawn), not threads",
        ),
        ("engine.start(); os.fork() or os._exit(tried()); os.wait()", "'spawn'"),
    ],
)
def test_threads_and_forks_get_a_sentence(how, advice):
    code = f"""
import os, threading
from acwm_core.errors import AcwmError
from acwm_sim import engine
def tried():
    try:
        engine.start()
    except AcwmError as error:
        print(error, flush=True)
        return 0
{how}
"""
    result = run(code)
    assert advice in result.stdout, result.stderr


def test_a_missing_libx11_names_the_package(tmp_path: Path):
    error = "libX11.so.6: cannot open shared object file: No such file or directory"
    (tmp_path / "taichi.py").write_text(f"raise ImportError({error!r})")
    result = run("import acwm_sim.engine", PYTHONPATH=str(tmp_path))
    assert "apt-get install libx11-6" in result.stderr.splitlines()[-1]
