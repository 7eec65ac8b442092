"""Which clips each step of training takes: a pure function of seed and position.

Training reads an endless stream of epochs, each a permutation of all clips. Step s of W ranks with
batches of B takes the next W·B clips of it, B per rank. So every rank takes the same number of
steps; every clip comes once per epoch of the stream, none is dropped or repeated at a boundary;
and the position, one number, is all there is to save.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Sampler


def epoch_order(length: int, seed: int, epoch: int) -> NDArray[np.int64]:
    """The permutation of ``0 … length − 1`` in which `epoch` takes the clips."""
    key = np.random.SeedSequence([seed, epoch])
    return np.random.Generator(np.random.Philox(key)).permutation(length)


class ClipSampler(Sampler[list[int]]):
    """A batch sampler over that stream, which has no end; a pass is ``len(self)`` batches of it.

    Args:
        length: number of clips.
        batch_size: clips per batch of one rank.
        seed: seed of the order.
        rank: this process, 0 … world_size − 1.
        world_size: number of processes that train together.

    Attributes:
        position: clips of the stream that all ranks together took before an iteration begins. An
            iteration leaves it alone: the consumer, who knows what was used and not only
            prefetched, sets it.
    """

    def __init__(
        self, length: int, *, batch_size: int, seed: int = 0, rank: int = 0, world_size: int = 1
    ) -> None:
        if length < 1:
            raise ValueError("there are no clips to sample from")
        self.length, self.batch_size, self.seed = length, batch_size, seed
        self.rank, self.world_size = rank, world_size
        self.position = 0

    @property
    def clips_per_step(self) -> int:
        """Clips that all ranks together take in one step."""
        return self.batch_size * self.world_size

    @property
    def remainder(self) -> int:
        """Clips of the next epoch that the last step of a pass takes, in all ranks together."""
        return len(self) * self.clips_per_step - self.length

    def __len__(self) -> int:
        """Steps in which all clips come at least once; the last may reach into the next epoch."""
        return -(-self.length // self.clips_per_step)

    def __iter__(self) -> Iterator[list[int]]:
        first = self.position + self.rank * self.batch_size
        for step in itertools.count():
            yield self._clips(first + step * self.clips_per_step)

    def _clips(self, start: int) -> list[int]:
        """The clips of one batch, from place `start` of the stream on."""
        epoch, offset = divmod(start, self.length)
        taken: list[int] = []
        while len(taken) < self.batch_size:
            taken += self._order(epoch)[offset:][: self.batch_size - len(taken)].tolist()
            epoch, offset = epoch + 1, 0
        return taken

    def _order(self, epoch: int) -> NDArray[np.int64]:
        """`epoch_order`, kept while the stream is in that epoch."""
        if getattr(self, "_epoch", None) != epoch:
            self._epoch, self._permutation = epoch, epoch_order(self.length, self.seed, epoch)
        return self._permutation
