"""Which clips each step of training takes: a pure function of seed and position.

Training reads an endless stream of epochs, each a permutation of all clips. Step s of W ranks with
batches of B takes the next W·B clips of it, B per rank. So every rank takes the same number of
steps; every clip comes once per epoch of the stream, none is dropped or repeated at a boundary;
and the position, one number, is all there is to save.

Clips of several lengths, which no batch can hold together, make as many such streams. Each
optimiser step takes all its clips from one of them. The streams take turns, evenly spread and each
as often as it has clips, so that every clip comes equally often, and which stream a step takes is a
pure function of the step.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import Sampler


def epoch_order(length: int, seed: int, epoch: int, stream: int = 0) -> NDArray[np.int64]:
    """The permutation of ``0 … length − 1`` in which `epoch` of a stream takes its clips."""
    key = np.random.SeedSequence([seed, epoch, stream] if stream else [seed, epoch])
    return np.random.Generator(np.random.Philox(key)).permutation(length)


class Streams:
    """The endless stream of all clips, and which clips stand in it.

    Args:
        lengths: of each clip; the longest make stream 0.
        seed: seed of the order.
        step: clips of an optimiser step. All are of one length if they begin at a multiple of it.
    """

    def __init__(self, lengths: NDArray[np.int64], seed: int, step: int) -> None:
        self._seed, self._step = seed, step
        self._members = [np.flatnonzero(lengths == kind) for kind in np.unique(lengths)[::-1]]
        self._orders: dict[int, tuple[int, NDArray[np.int64]]] = {}
        counts = [len(members) for members in self._members]
        when = np.concatenate([(np.arange(count) + 0.5) / count for count in counts])
        whose = np.repeat(np.arange(len(counts)), counts)
        self._turns = whose[np.argsort(when, kind="stable")]  # of one cycle
        self._visits = np.zeros(len(lengths), np.int64)  # earlier turns of the same stream in it
        for stream, count in enumerate(counts):
            self._visits[self._turns == stream] = np.arange(count)

    @property
    def several(self) -> bool:
        """Whether there are clips of several lengths."""
        return len(self._members) > 1

    def clips(self, start: int, count: int) -> list[int]:
        """The `count` clips from place `start` on; of several streams, within one step."""
        if not self.several:
            return self._taken(0, start, count)
        step, offset = divmod(start, self._step)
        cycle, turn = divmod(step, len(self._turns))
        stream = int(self._turns[turn])
        visit = cycle * len(self._members[stream]) + int(self._visits[turn])
        return self._taken(stream, visit * self._step + offset, count)

    def _taken(self, stream: int, start: int, count: int) -> list[int]:
        """The clips of a stream from its own place `start` on."""
        members = self._members[stream]
        epoch, offset = divmod(start, len(members))
        taken: list[int] = []
        while len(taken) < count:
            order = self._order(stream, epoch)
            taken += members[order[offset:][: count - len(taken)]].tolist()
            epoch, offset = epoch + 1, 0
        return taken

    def _order(self, stream: int, epoch: int) -> NDArray[np.int64]:
        """`epoch_order`, kept while the stream is in that epoch."""
        if stream not in self._orders or self._orders[stream][0] != epoch:
            order = epoch_order(len(self._members[stream]), self._seed, epoch, stream)
            self._orders[stream] = epoch, order
        return self._orders[stream][1]


class ClipSampler(Sampler[list[int]]):
    """A batch sampler over that stream, which has no end; a pass is ``len(self)`` batches of it.

    Args:
        length: number of clips.
        batch_size: clips per batch of one rank.
        seed: seed of the order.
        rank: this process, 0 … world_size − 1.
        world_size: number of processes that train together.
        lengths: of each clip; all are alike by default.
        accumulated: batches of a rank that make an optimiser step.

    Attributes:
        position: clips of the stream that all ranks together took before an iteration begins. An
            iteration leaves it alone: the consumer, who knows what was used and not only
            prefetched, sets it.
    """

    def __init__(
        self,
        length: int,
        *,
        batch_size: int,
        seed: int = 0,
        rank: int = 0,
        world_size: int = 1,
        lengths: Sequence[int] | NDArray[np.int64] | None = None,
        accumulated: int = 1,
    ) -> None:
        if length < 1:
            raise ValueError("there are no clips to sample from")
        self.length, self.batch_size, self.seed = length, batch_size, seed
        self.rank, self.world_size = rank, world_size
        self.position = 0
        alike = np.zeros(length, np.int64) if lengths is None else np.asarray(lengths, np.int64)
        self._streams = Streams(alike, seed, accumulated * self.clips_per_step)

    @property
    def clips_per_step(self) -> int:
        """Clips that all ranks together take at once, in one batch each."""
        return self.batch_size * self.world_size

    @property
    def remainder(self) -> int:
        """Clips of the next epoch that the last step of a pass takes, in all ranks together."""
        return len(self) * self.clips_per_step - self.length

    def __len__(self) -> int:
        """Steps of as many clips as there are; the last may reach into the next epoch."""
        return -(-self.length // self.clips_per_step)

    def __iter__(self) -> Iterator[list[int]]:
        start = self.position
        if self._streams.several:  # only if steps were of another size before is this not so yet
            start -= start % self.clips_per_step
        first = start + self.rank * self.batch_size
        for step in itertools.count():
            yield self._streams.clips(first + step * self.clips_per_step, self.batch_size)
