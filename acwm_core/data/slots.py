"""Memory that a worker shares with the training process, used again for one batch after another.

PyTorch sends each tensor of a batch over a socket of its own and maps fresh memory for it. For
small clips that costs more than reading them, and copying large ones into memory of the training
process takes as long as decoding half of them. Here a tensor is sent so once per slot; afterwards a
worker writes into the slots in turn and says which. A batch is lent, not copied: its slot is used
again when nothing refers to its tensors any more.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast, runtime_checkable

import torch
from torch import Tensor

AHEAD = 2
"""Batches that each worker fetches ahead."""

SLOTS = AHEAD + 3
"""Of each worker and length of clips at most: one for each batch ahead, one that is being filled,
and two lent out, as trainers hold the batch after the present one. Whoever keeps more gets memory
of their own."""


@runtime_checkable
class Batched(Protocol):
    """A dataset that reads the collated batch of some items faster than one by one."""

    def batch(self, indices: Sequence[int], into: Any = None) -> Any:
        """The items, as a dict of tensors; those of `into`, an earlier batch of as many, if given.

        What `into` held is lost, also if this raises.
        """
        ...


@dataclass(frozen=True)
class Slot:
    """Shared memory of one batch.

    Attributes:
        tensors: the batch by name.
        lent: uint8, one per tensor: 1 from when the worker fills it until nothing uses it.
    """

    tensors: dict[str, Tensor]
    lent: Tensor


@dataclass(frozen=True)
class InSlot:
    """A batch in a slot.

    Attributes:
        worker: whose.
        number: of the slot; None if it is used for this batch only.
        slot: the slot itself when it is used for the first time.
    """

    worker: int
    number: int | None
    slot: Slot | None


class Outbox:
    """A worker's slots."""

    def __init__(self) -> None:
        self._slots: list[tuple[int, Slot]] = []

    def fill(
        self, dataset: Batched, indices: Sequence[int], worker: int, length: int = 0
    ) -> InSlot:
        """Read a batch of items of that length into a slot that is free, or a new one."""
        alike = [
            (number, slot) for number, (kind, slot) in enumerate(self._slots) if kind == length
        ]
        for number, slot in alike:
            fits = all(len(tensor) == len(indices) for tensor in slot.tensors.values())
            if fits and not slot.lent.any():
                dataset.batch(indices, slot.tensors)
                slot.lent.fill_(1)
                return InSlot(worker, number, None)
        batch: dict[str, Tensor] = dataset.batch(indices)
        slot = Slot(batch, torch.ones(len(batch), dtype=torch.uint8))
        for tensor in (slot.lent, *batch.values()):
            tensor.share_memory_()
        if len(alike) == SLOTS:
            return InSlot(worker, None, slot)
        self._slots.append((length, slot))
        return InSlot(worker, len(self._slots) - 1, slot)


class Inbox:
    """The slots of all workers, in the training process."""

    def __init__(self) -> None:
        self._slots: dict[tuple[int, int], Slot] = {}

    def batch(self, sent: InSlot, *, pin: bool = False) -> dict[str, Tensor]:
        """The batch, whose slot is not filled again before it is let go; page-locked if `pin`."""
        slot = self._slot(sent)
        lent = _lend(slot)
        return pinned(lent) if pin else lent

    def _slot(self, sent: InSlot) -> Slot:
        if sent.number is None:
            assert sent.slot is not None
            return sent.slot
        if sent.slot is not None:
            self._slots[sent.worker, sent.number] = sent.slot
        return self._slots[sent.worker, sent.number]


def _lend(slot: Slot) -> dict[str, Tensor]:
    """Tensors over the slot's memory; when the last view of one is gone, its flag falls."""
    flags = slot.lent.numpy()
    lent: dict[str, Tensor] = {}
    for place, (name, tensor) in enumerate(slot.tensors.items()):
        array = tensor.view(torch.uint8).numpy()  # bytes, as NumPy knows no bfloat16
        weakref.finalize(array, flags.__setitem__, place, 0).atexit = False
        storage = cast(Tensor, cast(Any, torch).from_numpy(array))  # keeps the array
        lent[name] = storage.view(tensor.dtype)
    return lent


def pinned(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """A copy in page-locked memory, from which a GPU copies in the background."""
    return {name: tensor.pin_memory() for name, tensor in batch.items()}
