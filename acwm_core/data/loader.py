"""`ResumableLoader`: batches for training that continue exactly where a checkpoint was taken."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from typing import Any, Generic, TypeVar, cast

from torch.utils.data import DataLoader, Dataset

from acwm_core.data.fetching import (
    Fetched,
    Fetching,
    Replacements,
    SizedDataset,
    as_fetched,
    lengths_of,
)
from acwm_core.data.sampler import ClipSampler
from acwm_core.data.slots import AHEAD, Inbox, InSlot, pinned

Item_co = TypeVar("Item_co", covariant=True)


class ResumableLoader(Generic[Item_co]):
    """An iterable of collated batches with the `state_dict` protocol that Lightning saves.

    Every pass yields ``len(self)`` batches of the endless stream of `ClipSampler`. The state
    counts clips that were handed out, not those that background workers have fetched ahead. After
    `load_state_dict` the stream goes on with the very next clip, and the interrupted pass with the
    rest of its batches. With another number of ranks or another batch size it still goes on with
    the next clip of the stream, in batches cut otherwise, and begins a new pass.

    It shards by rank by itself: give Lightning's Trainer ``use_distributed_sampler=False``.

    Args:
        dataset: map-style; its items are collated as PyTorch does by default, unless it has a
            method `batch` that reads many at once. If it has an array `lengths`, items of
            different lengths never share a batch.
        batch_size: clips per batch of this rank.
        seed: seed of the order; the same on every rank.
        rank: this process, 0 … world_size − 1.
        world_size: number of processes that train together.
        workers: background processes; 0 loads in this one.
        pin_memory: page-locked batches, for a GPU.
        skip_damaged: put other clips in the place of damaged ones, with a warning for each.
        accumulated: batches of a rank that make an optimiser step, all of one length.

    Attributes:
        replaced: clips that were replaced so far, by what is wrong with their shard.
    """

    def __init__(
        self,
        dataset: SizedDataset[Item_co],
        *,
        batch_size: int,
        seed: int = 0,
        rank: int = 0,
        world_size: int = 1,
        workers: int = 0,
        pin_memory: bool = False,
        skip_damaged: bool = False,
        accumulated: int = 1,
    ) -> None:
        self.dataset = dataset
        self.sampler = ClipSampler(
            len(dataset),
            batch_size=batch_size,
            seed=seed,
            rank=rank,
            world_size=world_size,
            lengths=lengths_of(dataset),
            accumulated=accumulated,
        )
        self._loader: DataLoader[Fetched] = DataLoader(
            cast(Dataset[Fetched], Fetching(dataset, skip_damaged=skip_damaged)),
            batch_sampler=self.sampler,
            num_workers=workers,
            collate_fn=cast(Any, as_fetched),
            # Simulators and thread pools of the parent do not survive a fork.
            multiprocessing_context="spawn" if workers else None,
            prefetch_factor=AHEAD if workers else None,
        )
        self._inbox, self._pin_memory = Inbox(), pin_memory
        self._stream: Iterator[Fetched] | None = None  # from `position` on, through all passes
        self._handed_out = 0  # batches of the current pass
        self.replaced = Replacements()

    def __len__(self) -> int:
        """Batches of one pass, the same on every rank."""
        return len(self.sampler)

    def __iter__(self) -> Iterator[Any]:
        """The rest of the current pass, or a new one if it has ended.

        Raises:
            DataError: a shard is missing, or damaged and not to be skipped.
        """
        if self._handed_out >= len(self):
            self._handed_out = 0
        if self._stream is None:
            self._stream = iter(self._loader)
        remaining = len(self) - self._handed_out
        for fetched in itertools.islice(self._stream, remaining):
            batch = self._received(self.replaced.batch_of(fetched))
            self.sampler.position += self.sampler.clips_per_step
            self._handed_out += 1
            yield batch

    def _received(self, batch: Any) -> Any:
        if isinstance(batch, InSlot):
            return self._inbox.batch(batch, pin=self._pin_memory)
        return pinned(batch) if self._pin_memory else batch

    def state_dict(self) -> dict[str, int]:
        """The position in the stream, in clips of all ranks, and in the pass, in batches."""
        return {
            "position": self.sampler.position,
            "batches": self._handed_out,
            "clips_per_step": self.sampler.clips_per_step,
        }

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Continue from what `state_dict` returned."""
        self.sampler.position = state["position"]
        same_steps = state["clips_per_step"] == self.sampler.clips_per_step
        self._handed_out = state["batches"] if same_steps else 0
        self._stream = None
