"""Recordings of noise, for tests of episodes of several lengths."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from acwm_formats.timeline import Recording


@dataclass(frozen=True)
class Noise:
    """Episodes with two actions, of so many frames of `side`² pixels; no frame repeats another."""

    frames: Sequence[int]
    side: int = 16

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> Recording:
        rng, length = np.random.default_rng(index), self.frames[index]
        frames = rng.integers(0, 256, (length, self.side, self.side, 3), dtype=np.uint8)
        return Recording(frames, rng.uniform(-1, 1, (length - 1, 2)).astype(np.float32), {})
