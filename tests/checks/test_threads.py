"""Simulators that run on Taichi give the same bytes when it has two threads to use."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from tests.checks.results import installed

FRAMES = 32
"""Of each episode."""

WITH_TWO_THREADS = """
import json, sys
import taichi
taichi.init(arch=taichi.cpu, cpu_max_num_threads=2, log_level=taichi.ERROR)
from tests.checks.test_threads import beginning
print(json.dumps({name: beginning(name) for name in sys.argv[1:]}))
taichi.reset()  # keeps what it compiled for the next time
"""

TWO = {"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2"}
"""For arithmetic outside of Taichi; the tests themselves run with one."""

SIMULATORS = {part.target.partition(":")[0]: part for part in reversed(installed("environment"))}
"""By module; other environments of the same module have the same simulator."""

NAMES = [
    pytest.param(part.name, marks=[] if part in SIMULATORS.values() else pytest.mark.slow)
    for part in installed("environment")
]


def beginning(name):
    spec = EpisodeSpec(name, "ood_test", 1)
    return simulate(make_environment(name, {"size": 64}), spec, frames=FRAMES).digests()


@pytest.fixture(scope="module")
def with_two_threads(request):
    """Of every environment, by one process, since simulators take long to import and compile."""
    tests = [item for item in request.session.items if item.path == request.path]
    ran = subprocess.run(
        [sys.executable, "-c", WITH_TWO_THREADS, *(item.callspec.params["name"] for item in tests)],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
        env={**os.environ, **TWO},
    )
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout.splitlines()[-1])


@pytest.mark.parametrize("name", NAMES)
def test_two_threads_give_the_same_bytes(name, with_two_threads):
    assert beginning(name) == with_two_threads[name]
