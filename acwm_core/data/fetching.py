"""Fetching a batch where it is loaded, which may be a worker process: damage comes back as words.

An exception that crosses from a worker arrives as pages of traceback. So a damaged shard is caught
where it is read, and raised, or counted, where the batch is used.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from typing import Any, Generic, NamedTuple, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from torch.utils import data as torch_data
from torch.utils.data import get_worker_info

from acwm_core.data.slots import Batched, Outbox
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


class Fetched(NamedTuple):
    """A batch, and what went wrong with it.

    Attributes:
        batch: the collated items, or the slot in which a worker put them; None if there is an
            error.
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
        self._outbox = Outbox()

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> Fetched:
        """A batch of one item."""
        return self.__getitems__([index])

    def __getitems__(self, indices: Sequence[int]) -> Fetched:
        """The batch of some items."""
        try:
            return Fetched(self._whole(indices), [], None)
        except DamagedShardError as error:
            if not self.skip_damaged:
                return Fetched(None, [], str(error))
        except DataError as error:
            return Fetched(None, [], str(error))
        try:
            return self._mended(indices)
        except DataError as error:
            return Fetched(None, [], str(error))

    def _whole(self, indices: Sequence[int]) -> Any:
        if self._batched and (worker := get_worker_info()):
            lengths = lengths_of(self.dataset)
            length = 0 if lengths is None else int(lengths[indices[0]])
            return self._outbox.fill(self._batched, indices, worker.id, length)
        if self._batched:
            return self._batched.batch(indices)
        return default_collate([self.dataset[index] for index in indices])

    def _mended(self, indices: Sequence[int]) -> Fetched:
        replaced: list[str] = []
        items = [self._item(index, replaced) for index in indices]
        return Fetched(default_collate(items), replaced, None)

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
