"""The messages between page and server over the socket.

The page sends JSON objects; ``type`` selects one of `PAGE_MESSAGES`. The server also sends JSON,
and frames as binary: the length of a JSON header as four bytes (little-endian), the header, the
pixels of the simulator's frames, and then those of the model's frames.
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

from acwm_core.env.episode import FactorValue
from acwm_core.errors import DataError
from acwm_core.files import parse_json, typed

MAX_MESSAGE = 2**14
"""Largest size of a message from the page, in bytes."""

WAITING = 3
"""Most messages with frames that wait for a slow page; older ones are dropped."""


@dataclass(frozen=True)
class Act:
    """Raw values of all action dimensions, held until the next message."""

    values: list[float]
    seq: int = 0


@dataclass(frozen=True)
class Point:
    """Places in the picture in place of raw values; see `acwm_play.layout.Pointing`."""

    places: list[list[float]]
    seq: int = 0


@dataclass(frozen=True)
class Move:
    """Move a thing that the model sees to a place in the picture; see `LiveModel.keypoints`."""

    number: int
    place: list[float]


@dataclass(frozen=True)
class Open:
    """Open another world, or another scene of the same world; a new scene without an index."""

    world: str | None = None
    index: int | None = None
    factors: dict[str, FactorValue] = field(default_factory=dict[str, FactorValue])


@dataclass(frozen=True)
class TakeOver:
    """Restart the model from the simulator's frame."""


@dataclass(frozen=True)
class Redraw:
    """Restart the model from the simulator's frame with another draw."""


@dataclass(frozen=True)
class Pause:
    """Pause or continue."""

    on: bool


@dataclass(frozen=True)
class Step:
    """While paused: advance by one latent frame."""


@dataclass(frozen=True)
class Speed:
    """Set the speed."""

    value: float


@dataclass(frozen=True)
class Drive:
    """Set who acts; a driver solves a task, by default the one that was chosen last."""

    by: str
    task: str | None = None


@dataclass(frozen=True)
class Record:
    """Start a recording, or end and save it."""

    on: bool


ServerMessage = Literal["world", "state", "figures", "busy", "notice", "goal", "attempt"]
"""Types of the server's JSON messages."""

PageMessage = Act | Point | Move | Open | TakeOver | Redraw | Pause | Step | Speed | Drive | Record

PAGE_MESSAGES: Mapping[str, type[Any]] = {
    **{"act": Act, "point": Point, "open": Open, "take_over": TakeOver, "pause": Pause},
    **{"step": Step, "speed": Speed, "drive": Drive, "record": Record, "redraw": Redraw},
    "move": Move,
}


def parse(text: str) -> PageMessage:
    """Parse a message from the page.

    Raises:
        DataError: the message is invalid.
    """
    try:
        values = parse_json(text)
        kind = PAGE_MESSAGES[values.pop("type")]
        message: PageMessage = typed(values, kind)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"the page sent an invalid message: {error}") from error
    return message


def pack(header: Mapping[str, Any], *frames: NDArray[np.uint8]) -> bytes:
    """Pack a message with frames, `[n, H, W, 3]` each, into bytes."""
    head = json.dumps({"n": len(frames[0]), "size": frames[0].shape[1:3], **header}).encode()
    return b"".join([struct.pack("<I", len(head)), head, *(f.tobytes() for f in frames)])


class Outbox:
    """Messages waiting to be sent: the latest of each text type, and the last few with frames.

    So a slow page takes bounded memory and still shows the present.

    Attributes:
        dropped: number of frame messages that were never sent.
    """

    def __init__(self) -> None:
        self._texts: dict[str, dict[str, Any]] = {}
        self._frames: deque[bytes] = deque()
        self.dropped = 0

    def put(self, kind: ServerMessage, /, **values: Any) -> None:
        """Add a text message, as the last; it replaces a waiting one of the same type."""
        self._texts.pop(kind, None)
        self._texts[kind] = {"type": kind, **values}

    def put_frames(self, message: bytes) -> None:
        """Add a message with frames; beyond `WAITING` the oldest is dropped."""
        self._frames.append(message)
        if len(self._frames) > WAITING:
            self._frames.popleft()
            self.dropped += 1

    def forget_frames(self) -> None:
        """Drop the frames of a scene that is over."""
        self._frames.clear()

    def take(self) -> str | bytes | None:
        """The next message to send, texts first; None if nothing waits."""
        if self._texts:
            return json.dumps(self._texts.pop(next(iter(self._texts))))
        return self._frames.popleft() if self._frames else None
