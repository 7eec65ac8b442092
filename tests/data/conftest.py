"""Registers the square world, where spawned workers can import it, and makes a dataset of it."""

import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
for place in (HERE, HERE.parents[1]):  # scripts of these tests import this file, too
    if str(place) not in sys.path:
        sys.path.insert(0, str(place))

from square_world import plugin  # noqa: E402

from acwm_core.data.generate import generate  # noqa: E402
from acwm_core.plugins import catalog  # noqa: E402
from tests.folders import checksums as checksums  # noqa: E402
from tests.folders import wait_until as wait_until  # noqa: E402

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
