"""Batches for training that continue exactly where a checkpoint was taken: `ResumableLoader`.

An exception in a worker process would arrive as pages of traceback. So errors of damaged shards are
caught where the shard is read, and raised (or counted) where the batch is used.
"""

from __future__ import annotations

import itertools
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from torch import Tensor
from torch.utils import data as torch_data
from torch.utils.data import DataLoader, Dataset, IterableDataset

from acwm_core.data.clips import ClipSampler
from acwm_core.data.episodes import Clips
from acwm_core.errors import AcwmWarning, DamagedShardError, DataError
from acwm_core.executors import without_interrupts

default_collate = cast(Any, torch_data).default_collate  # it has no types


WORKER_DIED = (
    "a process that reads data died, perhaps out of memory: run the same command again with "
    "resume=auto, and with fewer data.workers if it happens again"
)


class Fetched(NamedTuple):
    """A batch, and the problems met while reading it."""

    batch: Any  # the collated items; None if there is an error
    replaced: list[str]  # for each replaced item, what was wrong with it
    error: str | None  # why there is no batch


class Fetching(Dataset[Fetched]):
    """Batches of `clips`, for a `DataLoader` that does not collate by itself.

    Args:
        skip_damaged: replace each clip that raises `DamagedShardError` by another of the same
            length. The choice depends only on the index of the damaged clip.
    """

    def __init__(self, clips: Clips, *, skip_damaged: bool) -> None:
        self.clips, self.skip_damaged = clips, skip_damaged

    def __getitem__(self, indices: Sequence[int]) -> Fetched:
        """Read the batch of the clips `indices`."""
        replaced: list[str] = []
        try:
            try:
                return Fetched(self.clips.batch(indices), [], None)
            except DamagedShardError:
                if not self.skip_damaged:
                    raise
            items = [self._item(index, replaced) for index in indices]
            return Fetched(default_collate(items), replaced, None)
        except DataError as error:
            return Fetched(None, [], str(error))

    def _item(self, index: int, replaced: list[str]) -> dict[str, Tensor]:
        generator = np.random.Generator(np.random.Philox(np.random.SeedSequence([index])))
        alike = np.flatnonzero(self.clips.lengths == self.clips.lengths[index])
        others = (int(alike[int(generator.integers(len(alike)))]) for _ in range(100))
        reason = ""  # after 100 damaged clips, nearly everything must be damaged
        for each in itertools.chain([index], others):
            try:
                item = self.clips[each]
            except DamagedShardError as error:
                reason = reason or str(error)
                continue
            replaced += [reason] if reason else []
            return item
        raise DataError(f"too many clips are damaged to find a replacement: {reason}")


class Replacements(Counter[str]):
    """Counts the clips that were replaced so far, by the reason."""

    def batch_of(self, fetched: Fetched) -> Any:
        """Return the fetched batch and count its replaced clips; warns once for each reason.

        Raises:
            DataError: there is no batch.
        """
        if fetched.error is not None:
            raise DataError(fetched.error)
        for reason in fetched.replaced:
            self[reason] += 1
            if self[reason] == 1:
                why = f"damaged clips are replaced by others: {reason}"
                warnings.warn(why, AcwmWarning, stacklevel=3)
        return fetched.batch


class ClipLoader:
    """An endless stream of batches of clips.

    Attributes:
        sampler: its position counts the clips that were handed out to all ranks.
        replaced: number of clips that were replaced so far, by what is wrong with their shard.
    """

    def __init__(
        self, dataset: Dataset[Fetched], sampler: ClipSampler, workers: int, pin_memory: bool
    ) -> None:
        self.sampler, self.replaced = sampler, Replacements()
        self._loader: DataLoader[Fetched] = DataLoader(
            dataset,
            batch_size=None,
            sampler=None if isinstance(dataset, IterableDataset) else sampler,
            num_workers=workers,
            # Simulators and thread pools of the parent process do not survive a fork.
            multiprocessing_context="spawn" if workers else None,
            pin_memory=pin_memory,
        )

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        """Yield batches, starting at the sampler's position.

        Raises:
            DataError: a shard is missing, or damaged and not to be skipped; a worker died.
        """
        with without_interrupts():
            batches = iter(self._loader)
        while True:
            try:
                fetched = next(batches)
            except StopIteration:
                return
            except (OSError, EOFError) as error:  # a worker's pipe broke
                raise DataError(WORKER_DIED) from error
            batch = self.replaced.batch_of(fetched)
            self.sampler.position += self.sampler.clips_per_step
            yield batch


class ResumableLoader(ClipLoader):
    """An endless stream of batches in the order of `ClipSampler`, which can be resumed exactly.

    The sampler's position counts clips that were handed out, not those that background workers
    have prefetched. It is the only state to save: set it, and the stream resumes with the next
    clip, on any number of ranks and with any batch size.

    Args:
        clips: what to read; clips of different lengths never share a batch.
        workers: number of background processes; 0 loads in this one.
        pin_memory: page-locked batches, for a GPU.
        skip_damaged: replace damaged clips by others, with a warning for each reason.
        batches: `batch_size`, `seed`, `rank`, `world_size` and `accumulated`, as in `ClipSampler`.
    """

    def __init__(
        self,
        clips: Clips,
        *,
        workers: int = 0,
        pin_memory: bool = False,
        skip_damaged: bool = False,
        **batches: Any,
    ) -> None:
        sampler = ClipSampler(len(clips), lengths=clips.lengths, **batches)
        fetching = Fetching(clips, skip_damaged=skip_damaged)
        super().__init__(fetching, sampler, workers, pin_memory)
