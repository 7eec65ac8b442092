"""Encodes a dataset in a process of its own that waits, for tests that kill it there.

python encoding_slowly.py DATA LOG FREE: encodes, and adds its process id to LOG for every episode
that it encodes. After so many as are FREE it waits for a line.
"""

import os
import sys
from pathlib import Path

from blocks import Blocks

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.latents import encode_windows

FRAMES = 9


class Waiting(Blocks):
    """Blocks that wait for a line before another episode than the free ones."""

    def __init__(self, log, free):
        super().__init__(remembers=True)  # one call per episode
        self.log, self.free = Path(log), int(free)

    def _encode(self, video):
        with self.log.open("a") as file:
            file.write(f"{os.getpid()}\n")
        self.free -= 1
        if self.free == -1:
            sys.stdin.readline()
        return super()._encode(video)


if __name__ == "__main__":
    episodes = EpisodeDataset(sys.argv[1], "train")
    encode_windows(episodes, Waiting(*sys.argv[2:]), frames=FRAMES, progress=False)
