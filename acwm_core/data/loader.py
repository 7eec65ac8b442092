"""Batches of clips: the samplers that order them, and `ClipLoader`, which reads them."""

from __future__ import annotations

import contextlib
import itertools
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Dataset, IterableDataset

from acwm_core.data.clips import Clips
from acwm_core.errors import DataError
from acwm_core.executors import without_interrupts, worker_context

WORKER_DIED = (
    "a process that reads data died, perhaps out of memory: run the same command again with "
    "resume=auto, and with fewer data.workers if it happens again"
)

SHARED = Path("/dev/shm")
"""Where Linux keeps memory that processes share."""


def epoch_order(length: int, seed: int, epoch: int, stream: int = 0) -> NDArray[np.int64]:
    """The order of clips in epoch `epoch` of a stream: a permutation of ``0 … length − 1``."""
    key = np.random.SeedSequence([seed, epoch, stream] if stream else [seed, epoch])
    return np.random.Generator(np.random.Philox(key)).permutation(length)


class ClipSampler:
    """A batch sampler over an endless stream of epochs, each a permutation of all clips.

    A step of W ranks takes the next W·B clips, a batch of B per rank. A batch cannot hold clips of
    different lengths, so each length has its own stream. The streams take turns, evenly spread and
    in proportion to their clips; all clips of a step come from one stream.

    Args:
        length: number of clips.
        batch_size: clips per batch of one rank.
        seed: seed of the order; the same on every rank.
        rank: index of this process, 0 … world_size − 1.
        world_size: number of processes that train together.
        lengths: length of each clip; the longest form stream 0. All equal by default.
        accumulated: batches per rank and optimiser step, all of one length.
        origin: the position at which the stream begins; whole optimiser steps.

    Attributes:
        position: number of clips that all ranks together have taken; an iteration starts there.
            It is the only state to save: set it, and the stream resumes with the next clip, on any
            number of ranks and with any batch size. An iteration does not change it, because only
            the consumer knows which prefetched clips were used: it takes their `places`.
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
        origin: int = 0,
    ) -> None:
        if length < 1:
            raise ValueError("there are no clips to sample from")
        self.batch_size, self.seed = batch_size, seed
        self.rank, self.world_size = rank, world_size
        self.position = self._origin = origin
        self._step = accumulated * self.clips_per_step
        of_clips = np.zeros(length) if lengths is None else np.asarray(lengths)
        self._streams = [np.flatnonzero(of_clips == one) for one in np.unique(of_clips)[::-1]]
        self._orders: dict[int, tuple[int, NDArray[np.int64]]] = {}
        counts = [len(members) for members in self._streams]
        when = np.concatenate([(np.arange(count) + 0.5) / count for count in counts])
        whose = np.repeat(np.arange(len(counts)), counts)
        self._turns = whose[np.argsort(when, kind="stable")]  # stream of each step in one cycle
        self._visits = np.zeros(length, np.int64)  # earlier turns of its stream in the cycle
        for stream, count in enumerate(counts):
            self._visits[self._turns == stream] = np.arange(count)

    @property
    def clips_per_step(self) -> int:
        """Clips that all ranks together take per step, one batch each."""
        return self.batch_size * self.world_size

    def __iter__(self) -> Iterator[list[int]]:
        start = self.position
        if len(self._streams) > 1:  # round down, in case the size of a step has changed
            start -= start % self.clips_per_step
        first = start + self.rank * self.batch_size
        for place in itertools.count(first, self.clips_per_step):
            step, offset = divmod(place - self._origin, self._step)
            cycle, turn = divmod(step, len(self._turns))
            stream = int(self._turns[turn])
            visit = cycle * len(self._streams[stream]) + int(self._visits[turn])
            yield self._taken(stream, visit * self._step + offset)

    def places(self) -> Iterator[tuple[int, ...]]:
        """The places in the stream of each batch that is used; moves `position` past its step."""
        while True:
            start = self.position + self.rank * self.batch_size
            self.position += self.clips_per_step
            yield tuple(range(start, start + self.batch_size))

    def _taken(self, stream: int, start: int) -> list[int]:
        """A batch of clips of one stream, from position `start` in that stream on."""
        members, taken = self._streams[stream], list[int]()
        epoch, offset = divmod(start, len(members))
        while len(taken) < self.batch_size:
            if self._orders.get(stream, (-1,))[0] != epoch:  # cached for this epoch
                order = epoch_order(len(members), self.seed, epoch, stream)
                self._orders[stream] = epoch, order
            order = self._orders[stream][1]
            taken += members[order[offset:][: self.batch_size - len(taken)]].tolist()
            epoch, offset = epoch + 1, 0
        return taken


class InOrder:
    """A batch sampler over all clips once, longest first; the same on every rank.

    Each batch holds clips of one length; the last batch of a length may be smaller.
    """

    rank = 0

    def __init__(self, lengths: NDArray[np.int64], batch_size: int) -> None:
        groups = [np.flatnonzero(lengths == length) for length in np.unique(lengths)[::-1]]
        self._batches: list[list[int]] = [
            group[start : start + batch_size].tolist()
            for group in groups
            for start in range(0, len(group), batch_size)
        ]

    def __len__(self) -> int:
        return len(self._batches)

    def __iter__(self) -> Iterator[list[int]]:
        return iter(self._batches)

    def places(self) -> Iterator[tuple[int, ...]]:
        """The places of each batch's clips in the dataset."""
        return map(tuple, self._batches)


class ClipLoader:
    """The batches of a sampler: the arrays of `Clips.batch`, and the `"positions"` of their clips.

    Args:
        clips: read at random, or a stream of batches, see `acwm_core.data.streaming.ClipStream`.
        sampler: which clips come when; its `places` become the positions.
        workers: number of background processes; 0 loads in this one.
        pin_memory: page-locked batches, for a GPU.

    Attributes:
        order: the sampler. (Lightning expects PyTorch's own under the name `sampler`.)
    """

    def __init__(
        self,
        clips: Clips | IterableDataset[Any],
        sampler: ClipSampler | InOrder,
        *,
        workers: int = 0,
        pin_memory: bool = False,
    ) -> None:
        streams = isinstance(clips, IterableDataset)
        self._context = worker_context(__name__) if workers else None
        self.order = sampler
        self._loader: DataLoader[Any] = DataLoader(
            clips if streams else _Batches(clips),
            batch_size=None,
            sampler=None if streams else sampler,
            collate_fn=_shared if workers else None,
            num_workers=workers,
            multiprocessing_context=self._context,
            pin_memory=pin_memory,
        )

    def __len__(self) -> int:
        """The number of batches, if it ends."""
        return len(self._loader)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """Yield batches, starting at the sampler's position.

        Raises:
            DataError: a shard is missing or damaged, or a worker died.
        """
        with without_interrupts(self._context) if self._context else contextlib.nullcontext():
            batches = iter(self._loader)
        places = self.order.places()
        while True:
            try:
                batch = next(batches)
            except StopIteration:
                return
            except (OSError, EOFError) as error:  # a worker's pipe broke
                raise DataError(WORKER_DIED) from error
            if isinstance(batch, DataError):
                if self.order.rank:  # only the first process reports errors, not knowing of this
                    sys.stderr.write(f"acwm: {batch}\n")
                raise batch
            yield {**batch, "positions": next(places)}


def _shared(batch: Any) -> Any:
    """Move a batch to memory that is shared with the training process, in which it is sent.

    PyTorch does so by itself, in a thread whose error nobody sees: training would wait for ever.
    """
    if isinstance(batch, DataError):
        return batch
    try:
        for value in batch.values():
            cast(torch.Tensor, value).share_memory_()
    except RuntimeError as error:
        total = f" of {shutil.disk_usage(SHARED).total / 2**20:.0f} MB" if SHARED.exists() else ""
        return DataError(
            f"the shared memory {SHARED}{total}, through which workers send clips, is full: start "
            "a container with --shm-size=8g, or set data.workers=0 or a smaller data.batch_size "
            f"({str(error).splitlines()[0][:160]})"
        )
    return batch


class _Batches(Dataset[Any]):
    """Batches of clips by the indices of their clips.

    It returns a `DataError` instead of raising it, because an exception in a worker process would
    arrive as pages of traceback.
    """

    def __init__(self, clips: Clips) -> None:
        self.clips = clips

    def __getitem__(self, indices: Sequence[int]) -> Any:
        try:
            return self.clips.batch(indices)
        except DataError as error:
            return error
