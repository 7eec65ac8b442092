"""Encodes a dataset in a process of its own, slowly, for tests that kill it.

python encoding_slowly.py DATA LOG: says "ready", waits for a line, encodes, and adds its process
id to LOG for every episode that it encodes. After four it waits for a file ``go`` beside LOG.
"""

import os
import sys
import time
from pathlib import Path

from blocks import Blocks

from acwm_core.data.encoding import encode_windows
from acwm_core.data.episodes import EpisodeDataset

FRAMES = 9

ALONE = 4
"""Episodes before it waits."""


class Slow(Blocks):
    """Blocks that wait after some episodes."""

    def __init__(self, log):
        super().__init__(remembers=True)  # one call per episode
        self.log, self.encoded = Path(log), 0

    def _encode(self, video):
        with self.log.open("a") as file:
            file.write(f"{os.getpid()}\n")
        self.encoded += 1
        while self.encoded > ALONE and not self.log.with_name("go").exists():
            time.sleep(0.005)
        return super()._encode(video)


if __name__ == "__main__":
    print("ready", flush=True)
    sys.stdin.readline()
    episodes = EpisodeDataset(sys.argv[1], "train")
    encode_windows(episodes, Slow(sys.argv[2]), frames=FRAMES, progress=False)
