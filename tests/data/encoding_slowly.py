"""Encodes a dataset in a process of its own, slowly, for tests that kill it.

python encoding_slowly.py DATA LOG: says "ready", waits for a line, encodes, and adds its process
id to LOG for every episode that it encodes.
"""

import os
import sys
import time
from pathlib import Path

from blocks import Blocks

from acwm_core.data.encoding import encode_windows
from acwm_core.data.episodes import EpisodeDataset

FRAMES = 9


class Slow(Blocks):
    """Blocks that take their time."""

    def __init__(self, log):
        super().__init__(remembers=True)  # one call per episode
        self.log = Path(log)

    def _encode(self, video):
        with self.log.open("a") as file:
            file.write(f"{os.getpid()}\n")
        time.sleep(0.15)
        return super()._encode(video)


if __name__ == "__main__":
    print("ready", flush=True)
    sys.stdin.readline()
    episodes = EpisodeDataset(sys.argv[1], "train")
    encode_windows(episodes, Slow(sys.argv[2]), frames=FRAMES, progress=False)
