"""Simulated worlds in Gymnasium's processes: `vectorization_mode="async"`."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.ci

SCRIPT = """
import sys
import gymnasium
import numpy as np
import acwm

NAME = "acwm/push_cube-v0"


def main():
    if "used" in sys.argv:
        alone = gymnasium.make(NAME, size=32)
        alone.reset(seed=0)
    context = {"context": sys.argv[1]} if sys.argv[1] != "default" else {}
    many = gymnasium.make_vec(
        NAME, 2, vectorization_mode="async", size=32, vector_kwargs=context
    )
    frames, _ = many.reset(seed=3)
    after, *_ = many.step(np.zeros(many.action_space.shape, np.float32))
    many.close()
    single = gymnasium.make(NAME, size=32)
    for place in range(2):
        assert np.array_equal(frames[place], single.reset(seed=3 + place)[0])
        assert np.array_equal(after[place], single.step(np.zeros(2, np.float32))[0])
    print("equal")


if __name__ == "__main__":
    main()
"""


def said(tmp_path, *words):
    script = tmp_path / "async.py"
    script.write_text(SCRIPT)
    command = [sys.executable, str(script), *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    return done.stdout + done.stderr


@pytest.mark.parametrize("words", [("default",), ("forkserver", "used"), ("spawn",)])
def test_processes_simulate_as_this_one_does(words, tmp_path):
    assert said(tmp_path, *words).endswith("equal\n")


def test_after_a_world_was_used_the_way_out_is_named(tmp_path):
    assert "vector_kwargs={'context': 'forkserver'}" in said(tmp_path, "default", "used")
