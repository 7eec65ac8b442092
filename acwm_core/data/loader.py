"""Batches for training that continue exactly where a checkpoint was taken: `ResumableLoader`.

Exceptions of worker processes arrive as pages of traceback. So a damaged shard is caught where it
is read, and raised, or counted, where the batch is used.
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

default_collate = cast(Any, torch_data).default_collate  # of no type that pyright could read


WORKER_DIED = (
    "a process that reads data died, perhaps out of memory: run the same command again with "
    "resume=auto, and with fewer data.workers if it happens again"
)


class Fetched(NamedTuple):
    """A batch, and what went wrong with it."""

    batch: Any  # the collated items; None if there is an error
    replaced: list[str]  # per item that was replaced, what is wrong with it
    error: str | None  # why there is no batch


class Fetching(Dataset[Fetched]):
    """Batches of `clips`, for a `DataLoader` that collates nothing by itself.

    Args:
        skip_damaged: put another clip as long, a function of the damaged one's index alone, in
            the place of each clip that raises `DamagedShardError`.
    """

    def __init__(self, clips: Clips, *, skip_damaged: bool) -> None:
        self.clips, self.skip_damaged = clips, skip_damaged

    def __getitem__(self, indices: Sequence[int]) -> Fetched:
        """The batch of some clips."""
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
        reason = ""  # if that many are damaged, so is nearly everything
        for each in itertools.chain([index], others):
            try:
                item = self.clips[each]
            except DamagedShardError as error:
                reason = reason or str(error)
                continue
            replaced += [reason] if reason else []
            return item
        raise DataError(f"so much is damaged that nothing replaces it: {reason}")


class Replacements(Counter[str]):
    """Clips that were replaced so far, counted by what is wrong with theirs."""

    def batch_of(self, fetched: Fetched) -> Any:
        """What was fetched, after counting what was replaced; each reason is a warning once.

        Raises:
            DataError: there is no batch.
        """
        if fetched.error is not None:
            raise DataError(fetched.error)
        for reason in fetched.replaced:
            self[reason] += 1
            if self[reason] == 1:
                why = f"other clips replace damaged ones: {reason}"
                warnings.warn(why, AcwmWarning, stacklevel=3)
        return fetched.batch


class ClipLoader:
    """Batches of clips without end, and how many clips they had.

    Attributes:
        sampler: its position counts the clips that were handed out to all ranks.
        replaced: clips that were replaced so far, by what is wrong with their shard.
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
            # Simulators and thread pools of the parent do not survive a fork.
            multiprocessing_context="spawn" if workers else None,
            pin_memory=pin_memory,
        )

    def __iter__(self) -> Iterator[dict[str, Tensor]]:
        """The batches from the position on.

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
            except (OSError, EOFError) as error:  # of the pipes from a process that has ended
                raise DataError(WORKER_DIED) from error
            batch = self.replaced.batch_of(fetched)
            self.sampler.position += self.sampler.clips_per_step
            yield batch


class ResumableLoader(ClipLoader):
    """Batches without end: the stream of `ClipSampler` from its position on, which moves with them.

    The position counts clips that were handed out, not those that background workers have fetched
    ahead. It is all there is to save: set it, and the stream resumes with the very next clip, on
    any number of ranks and in batches of any size.

    Args:
        clips: what to read; those of different lengths never share a batch.
        workers: background processes; 0 loads in this one.
        pin_memory: page-locked batches, for a GPU.
        skip_damaged: put other clips in the place of damaged ones, with a warning for each.
        batches: `batch_size`, `seed`, `rank`, `world_size` and `accumulated`, as of `ClipSampler`.
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
