"""Simulators that run on Taichi give the same bytes when it has two threads to use."""

import json
import os
import subprocess
import sys

import pytest

from acwm_core.checks.trial import digests
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.episode import EpisodeSpec
from tests.checks.results import installed

WITH_TWO_THREADS = """
import json, sys
import taichi
taichi.init(arch=taichi.cpu, cpu_max_num_threads=2, log_level=taichi.ERROR)
from acwm_core.checks.trial import digests
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.episode import EpisodeSpec
name, frames = sys.argv[1], int(sys.argv[2])
episode = simulate(
    make_environment(name, {"size": 64}), EpisodeSpec(name, "ood_test", 1), frames=frames
)
print(json.dumps(digests(episode)))
"""


TWO = {"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
"""For arithmetic outside of Taichi; the tests themselves run with one."""

FRAMES = 64
"""Of each episode."""


@pytest.mark.parametrize("part", installed("environment"), ids=lambda part: part.name)
def test_two_threads_give_the_same_bytes(part):
    spec = EpisodeSpec(part.name, "ood_test", 1)
    with_one = digests(simulate(make_environment(part, {"size": 64}), spec, frames=FRAMES))
    ran = subprocess.run(
        [sys.executable, "-c", WITH_TWO_THREADS, part.name, str(FRAMES)],
        capture_output=True,
        text=True,
        env={**os.environ, **TWO},
    )
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout.splitlines()[-1]) == with_one
