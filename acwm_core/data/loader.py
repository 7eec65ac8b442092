"""Batches for training that continue exactly where a checkpoint was taken: `ResumableLoader`.

A batch is fetched where it is loaded, which may be a worker process. An exception that crosses from
there arrives as pages of traceback. So a damaged shard is caught where it is read, and raised, or
counted, where the batch is used.
"""

from __future__ import annotations

import itertools
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, cast, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from torch.utils import data as torch_data
from torch.utils.data import DataLoader, Dataset

from acwm_core.data.clips import ClipSampler
from acwm_core.errors import DamagedShardError, DataError

Item_co = TypeVar("Item_co", covariant=True)
default_collate = cast(Any, torch_data).default_collate  # of no type that pyright could read

ATTEMPTS = 100
"""Clips tried in the place of a damaged one. If all are damaged, so is nearly everything."""


class SizedDataset(Protocol[Item_co]):
    """A map-style dataset that knows its length."""

    def __len__(self) -> int:
        """Number of items."""
        ...

    def __getitem__(self, index: int) -> Item_co:
        """One item."""
        ...


def lengths_of(dataset: object) -> NDArray[np.int64] | None:
    """The lengths of the dataset's items, if it says that they differ."""
    return getattr(dataset, "lengths", None)


@runtime_checkable
class Batched(Protocol):
    """A dataset that reads the collated batch of some items faster than one by one."""

    def batch(self, indices: Sequence[int]) -> Any:
        """The items, as a dict of tensors."""
        ...


class Fetched(NamedTuple):
    """A batch, and what went wrong with it.

    Attributes:
        batch: the collated items; None if there is an error.
        replaced: per item that was replaced, what is wrong with it.
        error: why there is no batch.
    """

    batch: Any
    replaced: list[str]
    error: str | None


class Fetching(Generic[Item_co]):
    """Batches of `dataset`, for a `DataLoader` that collates nothing by itself.

    Args:
        dataset: what to read.
        skip_damaged: put another item as long, a function of the damaged one's index alone, in
            the place of each item that raises `DamagedShardError`.
    """

    def __init__(self, dataset: SizedDataset[Item_co], *, skip_damaged: bool) -> None:
        self.dataset, self.skip_damaged = dataset, skip_damaged
        self._batched = dataset if isinstance(dataset, Batched) else None

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> Fetched:
        """A batch of one item."""
        return self.__getitems__([index])

    def __getitems__(self, indices: Sequence[int]) -> Fetched:
        """The batch of some items."""
        try:
            if self._batched:
                return Fetched(self._batched.batch(indices), [], None)
            return Fetched(default_collate([self.dataset[i] for i in indices]), [], None)
        except DataError as error:
            if not (self.skip_damaged and isinstance(error, DamagedShardError)):
                return Fetched(None, [], str(error))
        try:
            replaced: list[str] = []
            items = [self._item(index, replaced) for index in indices]
            return Fetched(default_collate(items), replaced, None)
        except DataError as error:
            return Fetched(None, [], str(error))

    def _item(self, index: int, replaced: list[str]) -> Item_co:
        try:
            return self.dataset[index]
        except DamagedShardError as error:
            reason = str(error)
        replaced.append(reason)
        generator = np.random.Generator(np.random.Philox(np.random.SeedSequence([index])))
        lengths = lengths_of(self.dataset)
        alike = range(len(self.dataset))
        if lengths is not None:
            alike = np.flatnonzero(lengths == lengths[index])
        for _ in range(ATTEMPTS):
            try:
                return self.dataset[int(alike[int(generator.integers(len(alike)))])]
            except DamagedShardError:
                continue
        raise DataError(f"so much is damaged that nothing replaces it: {reason}")


def as_fetched(fetched: Any) -> Fetched:
    """What a `DataLoader` over `Fetching` collates with: the batch as it is."""
    return fetched


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
                warnings.warn(f"other clips replace damaged ones: {reason}", stacklevel=3)
        return fetched.batch


class ResumableLoader(Generic[Item_co]):
    """An iterable of collated batches with the `state_dict` protocol that Lightning saves.

    Every pass yields ``len(self)`` batches of the endless stream of `ClipSampler`. The state
    counts clips that were handed out, not those that background workers have fetched ahead. After
    `load_state_dict` the stream resumes with the very next clip, and the interrupted pass with the
    rest of its batches. With another number of ranks or another batch size it still resumes with
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
            pin_memory=pin_memory,
        )
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
            batch = self.replaced.batch_of(fetched)
            self.sampler.position += self.sampler.clips_per_step
            self._handed_out += 1
            yield batch

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
