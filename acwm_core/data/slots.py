"""Memory that a worker shares with the training process, used again for one batch after another.

PyTorch sends each tensor of a batch over a socket of its own and maps fresh memory for it. For
small clips that costs more than reading them. Here a tensor is sent so once per slot; afterwards a
worker writes into the slots in turn and says which.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

AHEAD = 2
"""Batches that each worker fetches ahead."""

SLOTS = AHEAD + 1
"""Of each worker: one for each batch ahead, and one from which the last is still being copied.

A worker is told to fetch another batch when the training process asks for one, so after it has
copied the one before; a slot that comes round again has been copied.
"""


@runtime_checkable
class Batched(Protocol):
    """A dataset that reads the collated batch of some items faster than one by one."""

    def batch(self, indices: Sequence[int], into: Any = None) -> Any:
        """The items, as a dict of tensors; those of `into`, an earlier batch of as many, if given.

        What `into` held is lost, also if this raises.
        """
        ...


@dataclass(frozen=True)
class InSlot:
    """A batch in a slot.

    Attributes:
        worker: whose.
        slot: its number, 0 … SLOTS − 1.
        tensors: the slot itself when it is used for the first time.
    """

    worker: int
    slot: int
    tensors: dict[str, Tensor] | None


class Outbox:
    """A worker's slots."""

    def __init__(self) -> None:
        self._slots: list[dict[str, Tensor] | None] = [None] * SLOTS
        self._next = 0

    def fill(self, dataset: Batched, indices: Sequence[int], worker: int) -> InSlot:
        """Read a batch into the next slot."""
        held = self._slots[self._next]
        if held is not None and any(len(tensor) != len(indices) for tensor in held.values()):
            held = None
        batch: dict[str, Tensor] = dataset.batch(indices, held)
        if batch is not held:
            for tensor in batch.values():
                tensor.share_memory_()
        sent = InSlot(worker, self._next, None if batch is held else batch)
        self._slots[self._next] = batch
        self._next = (self._next + 1) % SLOTS
        return sent


class Inbox:
    """The slots of all workers, in the training process."""

    def __init__(self) -> None:
        self._slots: dict[tuple[int, int], dict[str, Tensor]] = {}

    def copy(self, sent: InSlot, *, pin: bool = False) -> dict[str, Tensor]:
        """The batch, which stays as it is when its slot is filled again; page-locked if `pin`."""
        if sent.tensors is not None:
            self._slots[sent.worker, sent.slot] = sent.tensors
        held = self._slots[sent.worker, sent.slot]
        return pinned(held) if pin else {name: tensor.clone() for name, tensor in held.items()}


def pinned(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """A copy in page-locked memory, from which a GPU copies in the background."""
    return {name: tensor.pin_memory() for name, tensor in batch.items()}
