"""The guarded start of Taichi, in processes of its own."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from taichi.lang import impl

from acwm_sim import engine
from acwm_sim.kernels.arrays import F1, F2

ti = engine.ti


@ti.kernel
def add_rows(rows: F2, total: F1, times: ti.i32, scale: ti.f32, first: ti.template()):
    ti.loop_config(serialize=True)
    for i in range(first, rows.shape[0]):
        for k in ti.static(range(3)):
            total[k] += times * scale * rows[i, k]


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


def test_a_launcher_follows_its_arrays_and_takes_others():
    engine.start()
    launch, rows, total = engine.Launcher(add_rows), np.ones((4, 3), np.float32), np.zeros(3, "f4")
    launch(rows, total, 2, 0.5, 1)
    rows[3] = 10, 20, 30  # in place, so nothing is looked at anew
    launch(rows, total, 2, 0.5, 1)
    np.testing.assert_array_equal(total, [15, 25, 35])
    launch(rows[2:].copy(), total, 1, 2.0, 0)
    np.testing.assert_array_equal(total, [37, 67, 97])


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


@pytest.mark.ci
def test_what_was_compiled_is_kept_for_the_next_process(tmp_path: Path):
    """With torch and an environment, Taichi is not torn down at the end of a process."""
    (tmp_path / "kernel.py").write_text("""
from acwm_sim import engine

@engine.ti.kernel
def triple(x: float) -> float:
    return 3 * x
""")
    code = """
import torch
from kernel import triple
from acwm_core.plugins import catalog
environment = catalog().component("environment", "push_cube").create(size=(64, 64))
environment.reset(seed=0)
print(triple(2.0))
"""
    usual, cache = Path(impl.default_cfg().offline_cache_file_path), tmp_path / "cache"
    shutil.copytree(usual, cache) if usual.is_dir() else cache.mkdir()  # what others compiled
    before = {*cache.rglob("*.tic")}
    result = run(code, PYTHONPATH=str(tmp_path), TI_OFFLINE_CACHE_FILE_PATH=str(cache))
    assert result.stdout == "6.0\n", result.stderr
    assert {*cache.rglob("*.tic")} > before


def test_kernels_of_classes_are_found_as_taichi_finds_them(tmp_path, monkeypatch):
    """Taichi tells by a decorator's line whether what it decorates is a method."""
    (tmp_path / "counting.py").write_text("""
from acwm_sim.engine import ti

@ti.data_oriented
class Counter:
    def __init__(self):
        self.step = 2

    @ti.kernel
    def count(self, times: int) -> int:
        total = 0
        for _ in range(times):
            total += self.step
        return total

@ti.kernel
def triple(x: int) -> int:
    return 3 * x
""")
    code = """
from acwm_sim import engine
engine.start()
from counting import Counter, triple
print(Counter().count(4), triple(4))
"""
    result = run(code, PYTHONPATH=str(tmp_path))
    assert result.stdout == "8 12\n", result.stderr
