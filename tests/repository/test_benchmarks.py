"""The tables of speeds can be made, and add up."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def simulate(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import simulate

    return simulate


def table(*words):
    command = [sys.executable, str(BENCHMARKS / "simulate.py"), *words]
    sizes = ["--size", "32", "--episodes", "1", "--repeats", "1"]
    return subprocess.run([*command, *sizes], capture_output=True, text=True, timeout=600)


@pytest.mark.ci
def test_every_named_environment_gets_a_row():
    pytest.importorskip("mujoco")
    pytest.importorskip("taichi")
    done = table("push_cube")
    assert done.returncode == 0, done.stderr
    (row,) = [line.split() for line in done.stdout.splitlines() if line.startswith("push_cube")]
    assert row[1] == "32×32"
    assert float(row[2]) > 0
    shares = [int(row[k]) for k in (4, 6, 8)]
    assert sum(shares) == pytest.approx(100, abs=2)
    assert "Gymnasium Reacher-v5" in done.stdout
    assert "2,187 episodes of 1 world" in done.stdout


@pytest.mark.ci
def test_what_cannot_be_measured_is_named():
    done = table("push_cubes")
    assert done.returncode == 1
    assert "push_cubes" in done.stderr
    assert "unknown environment 'push_cubes'" in done.stdout


def test_the_whole_benchmark_is_added_up_without_variants(simulate):
    one = {
        "costs": [1.0, 2.0, 0.6],
        "ood_costs": [2.0, 4.0, 1.2],
        "episodes": {"train": 900, "ind_test": 100, "ood_test": 500},
        "variants": ["twin"],
    }
    twin = {**one, "variants": []}
    said = simulate.whole_benchmark({"world": one, "twin": twin})
    assert "1,500 episodes of 1 world would take 2.0 hours" in said  # 3600 + 3600 seconds


@pytest.mark.slow
def test_the_step_of_every_network_is_measured():
    pytest.importorskip("diffusers")
    words = ["--size", "small", "--precision", "bfloat16", "--quick", "--threads", "1"]
    command = [sys.executable, str(BENCHMARKS / "training.py"), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    named = [line for line in done.stdout.splitlines() if line.startswith("│ bfloat16")]
    cells = [[cell.strip() for cell in line.strip("│").split("│")] for line in named]
    assert [row[0] for row in cells] == [
        "bfloat16, acwm",
        "bfloat16, published, plain",
        "bfloat16, diffusers' Latte",
        "bfloat16, one product",
    ]
    ours, published = cells[0], cells[1]
    assert float(published[4]) == pytest.approx(float(published[3]) / float(ours[3]), abs=0.02)
    # The same network: as many operations, so that times and rates are inverse to each other.
    work = [float(row[3]) * float(row[5].replace(",", "")) for row in (ours, published)]
    assert work[0] == pytest.approx(work[1], rel=0.05)


@pytest.mark.slow
def test_streams_are_compared_with_what_they_equal():
    command = [
        sys.executable,
        str(BENCHMARKS / "rollout.py"),
        "--steps=1,2",
        "--seconds=0",
        "--threads=1",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if "no codec" in line]
    assert len(lines) == 2
    for line in lines:
        speed, later, latency, _, *_ = map(float, line.split("codec")[1].replace("│", " ").split())
        assert later == pytest.approx(4000 / latency, rel=0.1)
        assert speed > 0
    assert float(done.stdout.split()[-1]) < 1e-5
