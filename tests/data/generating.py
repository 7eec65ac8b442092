"""Generates a dataset of squares in a process of its own, for tests that kill it."""

import signal
import sys

from square_world import plugin

from acwm_core.data.generate import generate
from acwm_core.plugins import catalog

EPISODES = {"train": 12, "ind_test": 3}


def run(out, environment="gated_square", workers=2):
    """Make the dataset that the tests compare."""
    if "square_world" not in catalog().plugins:
        catalog().add_plugin(plugin(), "square_world")
    return generate(
        environment, out, episodes=EPISODES, workers=workers, shard_episodes=2, progress=False
    )


if __name__ == "__main__":
    # A shell's background job inherits Ctrl-C ignored; here it must end the command.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    run(sys.argv[1])
