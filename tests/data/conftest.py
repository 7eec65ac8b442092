"""Registers the square world, where spawned workers can import it, and makes a dataset of it."""

import sys
import time
from pathlib import Path

import pytest

HERE = str(Path(__file__).parent)
if HERE not in sys.path:
    sys.path.insert(0, HERE)

from square_world import plugin  # noqa: E402

from acwm_core.catalog import catalog  # noqa: E402
from acwm_core.data.generate import generate  # noqa: E402

if "square_world" not in catalog().plugins:
    catalog().add_plugin(plugin(), "square_world")

PATIENCE = 600
"""Seconds that a process may take on a busy machine before it counts as hanging."""

EPISODES = {"train": 11, "ind_test": 2, "ood_test": 5}


@pytest.fixture(scope="session")
def square_data(tmp_path_factory):
    """A finished dataset of 3 training shards, made in this process."""
    folder = tmp_path_factory.mktemp("data") / "square"
    generate("square", folder, episodes=EPISODES, workers=0, shard_episodes=4, progress=False)
    return folder


def wait_until(condition, process=None):
    """Wait for something that `process`, if it still runs, brings about within minutes."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert process is None or process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)


def checksums(folder):
    """SHA-256 of every file of a data folder but its lock."""
    import hashlib

    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(Path(folder).rglob("*"))
        if path.is_file() and path.name != ".lock"
    }
