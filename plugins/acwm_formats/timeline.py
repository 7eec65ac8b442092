"""Recordings with their times: what every format reads, before anything is aligned or decoded.

A recording is frames with times and actions with times. A format says what its files say, and no
more: it neither cuts nor resamples, and decodes no frame before it is asked to. How frames, actions
and states are brought together is decided in one place, `acwm_formats.alignment`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.card import ActionKind, StateField
from acwm_core.env.episode import Split


class Frames(Protocol):
    """The frames of one camera, read on request; picklable.

    `acwm_formats.frames` has those of a video file and those of arrays and pictures.
    """

    @property
    def times(self) -> NDArray[np.float64]:
        """When each frame is shown, ``[N]`` in seconds on the recording's own clock.

        They start where they start, and are neither sorted nor evened out. No frame is decoded.
        """
        ...

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of a frame as it is shown: upright, with square pixels."""
        ...

    @property
    def depth(self) -> bool:
        """Whether it is a depth map, which has no colours: see `read`."""
        ...

    @property
    def stamp(self) -> str:
        """What changes when the frames do, e.g. the date of the file; imports resume by it."""
        ...

    def read(
        self, indices: Sequence[int], depth_range: tuple[float, float] | None = None
    ) -> Iterator[NDArray[np.uint8]]:
        """Decode frames ``[H, W, 3]`` uint8, one for each of the indices, which never decrease.

        Args:
            indices: places in `times`; one may be there several times.
            depth_range: distances in metres that become white and black, for a depth map.

        Raises:
            DataError: a frame cannot be read or converted.
        """
        ...


@dataclass(frozen=True)
class Samples:
    """Numbers over time: actions, or one of the states.

    Attributes:
        values: ``[N, …]``, any type of number.
        times: ``[N]`` in seconds on the clock of the frames. An action holds from its time on.
        frames: ``[N]``, the number of the frame that each row belongs to, counted from 0 and also
            over lost frames. Without `times` and `frames`, row i belongs to frame i.
    """

    values: NDArray[Any]
    times: NDArray[np.float64] | None = None
    frames: NDArray[np.integer[Any]] | None = None


@dataclass(frozen=True)
class TimedRecording:
    """One recorded episode, not yet decoded.

    Attributes:
        name: what its owner knows it by, e.g. ``"episode 12"`` or ``"run 3.mp4"``.
        cameras: frames by the name of the camera, in the source's order.
        actions: ``[N, A]``.
        states: ``[N, …]`` by name.
        rate: frames per second that the source claims.
        length: number of frames that the source claims.
        facts: what else is known of the episode, for JSON: `task`, `reward`, …
    """

    name: str
    cameras: Mapping[str, Frames]
    actions: Samples
    states: Mapping[str, Samples] = field(default_factory=dict[str, Samples])
    rate: Fraction | None = None
    length: int | None = None
    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])


class Recordings(Protocol):
    """Recordings by index, from 0: a list, or an object that opens them on request.

    To be sent to workers, it must be picklable, importable and small. An error of ``__getitem__``
    (a `DataError` or an `OSError`) counts as a defect of that recording.
    """

    def __len__(self) -> int:
        """Number of recordings."""
        ...

    def __getitem__(self, index: int, /) -> TimedRecording:
        """Open one recording, without decoding its frames."""
        ...


@dataclass(frozen=True)
class ActionFacts:
    """What is known of the actions before they are read.

    Attributes:
        names: one per dimension; ``action_0``, … if it is empty.
        units: one per dimension; none if it is empty.
        kind: what an action commands.
        bounds: lower and upper bounds that are stated; an action beyond them is a defect. None:
            those of the training episodes.
    """

    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    kind: ActionKind = "absolute"
    bounds: tuple[tuple[float, ...], tuple[float, ...]] | None = None


@dataclass(frozen=True)
class RecordedDataset:
    """What a format read: recordings to import.

    Attributes:
        name: the environment that they show, one word.
        splits: the recordings of each split; or all of them, if the source does not divide them, so
            that the last become test episodes.
        facts: `kind` (the format) and `name` of what is imported, and what identifies it.
        options: the format's own options, for the command that imports it again; None if no command
            does.
        actions: what is known of the actions.
        state: the states to keep; None keeps all that the first recording has.
        notes: sentences for people, kept in the card.
        seed: seed of the dataset, if the recordings were made with one.
        simulated: recordings are made when they are opened, which is costly. So they are opened
            once, and their rate and the bounds of actions must be stated.
        summary: one sentence about the data.
        engine: what made it.
        citation: its source.
    """

    name: str
    splits: Mapping[Split, Recordings] | Recordings
    facts: Mapping[str, Any]
    options: Mapping[str, object] | None = None
    actions: ActionFacts = ActionFacts()
    state: tuple[StateField, ...] | None = None
    notes: tuple[str, ...] = ()
    seed: int = 0
    simulated: bool = False
    summary: str = ""
    engine: str = "recorded"
    citation: str = ""
