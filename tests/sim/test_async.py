"""Simulated worlds in Gymnasium's processes: `vectorization_mode="async"`."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.ci

SCRIPT = """
import gymnasium
import numpy as np
import acwm

NAME = "acwm/push_cube-v0"
STILL = np.zeros(2, np.float32)


def steps(**context):
    many = gymnasium.make_vec(
        NAME, 2, vectorization_mode="async", size=32, vector_kwargs=context
    )
    frames, _ = many.reset(seed=3)
    after, *_ = many.step(np.tile(STILL, (2, 1)))
    many.close()
    return [*zip(frames, after)]


def main():
    many = {"default": steps()}  # before this process has used a world
    single = gymnasium.make(NAME, size=32)
    alone = [(single.reset(seed=seed)[0], single.step(STILL)[0]) for seed in (3, 4)]
    many |= {name: steps(context=name) for name in ("forkserver", "spawn")}
    for name, frames in many.items():
        assert np.array_equal(frames, alone), name
    print("equal", flush=True)
    steps()


if __name__ == "__main__":
    main()
"""


def test_processes_simulate_as_this_one_does_and_where_they_cannot_the_way_out_is_named(tmp_path):
    script = tmp_path / "async.py"
    script.write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=300
    )
    assert done.stdout == "equal\n", done.stderr
    assert "vector_kwargs={'context': 'forkserver'}" in done.stderr
