"""What an importer hands over: recordings in random access, and what is known of them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

from acwm_core.data.exchange.recording import Recording
from acwm_core.environment import EnvironmentCard
from acwm_core.episode import Split


class Recordings(Protocol):
    """Recordings by index, from 0: a list, or an object that reads them when it is asked.

    For workers it must be picklable, importable and small.
    """

    def __len__(self) -> int:
        """How many there are."""
        ...

    def __getitem__(self, index: int, /) -> Recording:
        """One of them."""
        ...


def import_command(kind: str, name: str, **options: object) -> str:
    """``acwm data import KIND NAME --option value …``, without options that are None."""
    words = ["acwm", "data", "import", kind, name]
    for option, value in options.items():
        if value is not None:
            words += [f"--{option.replace('_', '-')}", _word(value)]
    return shlex.join(words)


def _word(value: object) -> str:
    if isinstance(value, tuple):  # a frame size
        return "x".join(str(part) for part in cast(tuple[object, ...], value))
    return str(value)


@dataclass(frozen=True)
class Source:
    """Recordings to import.

    Attributes:
        environment: what they show; `recorded_card` makes one.
        splits: the recordings of each split.
        facts: `kind` and `name` of what is imported, and whatever tells it from another such
            thing, e.g. checksums; kept in the card and compared when an import is resumed. For
            people, the `command` that imports it, as `import_command` writes it.
        notes: sentences for people, kept in the card.
        seed: seed of the dataset, where recordings are made from one.
        nominal: how many frames each recording of a split is said to have; those that turn out to
            have fewer are counted in the notes.
    """

    environment: EnvironmentCard
    splits: Mapping[Split, Recordings]
    facts: Mapping[str, Any]
    notes: tuple[str, ...] = ()
    seed: int = 0
    nominal: Mapping[Split, Sequence[int]] = field(default_factory=dict[Split, Sequence[int]])
