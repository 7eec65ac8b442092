"""What page and server say to each other over the socket.

The page sends JSON objects, one of `WISHES` each by its ``type``. The server sends JSON as well,
and frames in binary: the length of a JSON header as four bytes, lowest first, the header, and the
pixels of the simulator's and then of the model's frames.
"""

from __future__ import annotations

import json
import struct
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from acwm_core.episode import FactorValue
from acwm_core.errors import DataError
from acwm_core.untrusted import parse_json, typed

MAX_MESSAGE = 2**14
"""Bytes of a message from the page."""

WAITING = 3
"""Messages of frames that wait for a slow page; older ones are dropped."""


@dataclass(frozen=True)
class Act:
    """Raw values of all dimensions, held until the next."""

    values: list[float]
    seq: int = 0


@dataclass(frozen=True)
class Point:
    """Places in the picture instead, see `acwm_play.layout.Pointing`."""

    places: list[list[float]]
    seq: int = 0


@dataclass(frozen=True)
class Open:
    """Another world, or another scene of the same: a new one where no index is given."""

    world: str | None = None
    index: int | None = None
    factors: dict[str, FactorValue] = field(default_factory=dict[str, FactorValue])


@dataclass(frozen=True)
class TakeOver:
    """The model begins anew from the simulator's frame."""


@dataclass(frozen=True)
class Pause:
    """Stop, or go on."""

    on: bool


@dataclass(frozen=True)
class Step:
    """While it is paused: one latent frame more."""


@dataclass(frozen=True)
class Speed:
    """Slow motion."""

    value: float


@dataclass(frozen=True)
class Drive:
    """Who acts."""

    by: str


@dataclass(frozen=True)
class Record:
    """Begin a recording, or end and save it."""

    on: bool


Wish = Act | Point | Open | TakeOver | Pause | Step | Speed | Drive | Record

WISHES: Mapping[str, type[Any]] = {
    **{"act": Act, "point": Point, "open": Open, "take_over": TakeOver, "pause": Pause},
    **{"step": Step, "speed": Speed, "drive": Drive, "record": Record},
}


def parse(text: str) -> Wish:
    """A message of the page.

    Raises:
        DataError: it is none.
    """
    try:
        values = parse_json(text)
        kind = WISHES[values.pop("type")]
        wish: Wish = typed(values, kind)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"the page sent an invalid message: {error}") from error
    return wish


def pack(header: Mapping[str, Any], *frames: NDArray[np.uint8]) -> bytes:
    """The bytes of a message of frames, each `[n, H, W, 3]`."""
    head = json.dumps({"n": len(frames[0]), "size": frames[0].shape[1:3], **header}).encode()
    return b"".join([struct.pack("<I", len(head)), head, *(f.tobytes() for f in frames)])


class Outbox:
    """What waits to be sent: of each type of message the latest, and the last few of frames.

    So a slow page costs bounded memory and sees the present.

    Attributes:
        dropped: messages of frames that were never sent.
    """

    def __init__(self) -> None:
        self._texts: dict[str, dict[str, Any]] = {}
        self._frames: deque[bytes] = deque()
        self.dropped = 0

    def put(
        self, kind: Literal["world", "state", "figures", "busy", "notice"], /, **values: Any
    ) -> None:
        """Text; an earlier one of the same type that still waits is forgotten."""
        self._texts[kind] = {"type": kind, **values}

    def put_frames(self, message: bytes) -> None:
        """Frames; beyond `WAITING` the oldest are dropped."""
        self._frames.append(message)
        if len(self._frames) > WAITING:
            self._frames.popleft()
            self.dropped += 1

    def forget_frames(self) -> None:
        """Of a scene that is over."""
        self._frames.clear()

    def take(self) -> str | bytes | None:
        """The next to send, texts first; None if nothing waits."""
        if self._texts:
            return json.dumps(self._texts.pop(next(iter(self._texts))))
        return self._frames.popleft() if self._frames else None
