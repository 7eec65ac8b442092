"""Recordings with their times: what every format reads, before anything is aligned or decoded.

A recording is frames with times and actions with times. A format says what its files say, and no
more: it neither cuts nor resamples, and decodes no frame before it is asked to. How frames, actions
and states are brought together is decided in one place, `acwm_formats.alignment`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.card import ActionKind, StateField
from acwm_core.env.episode import Split
from acwm_core.errors import DataError
from acwm_formats.channels import Channels
from acwm_formats.frames import ImageFrames
from acwm_formats.labels import Labels


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
        labels: masks and contacts, if the frames are labelled.
        notes: what people should know about it, a phrase each.
    """

    name: str
    cameras: Mapping[str, Frames]
    actions: Samples
    states: Mapping[str, Samples] = field(default_factory=dict[str, Samples])
    rate: Fraction | None = None
    length: int | None = None
    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])
    labels: Labels | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Recording:
    """One recorded episode as arrays.

    Attributes:
        video: ``[T, H, W, 3]`` uint8; other images are converted as `acwm_formats.images` says.
        actions: ``[T, A]`` or ``[T − 1, A]``; row i leads from frame i to frame i + 1, so a T-th
            row leads to no frame and is dropped.
        states: arrays of numbers by name, each ``[T, …]``.
        times: ``[T]`` when each frame was taken, in seconds; by default at the dataset's rate.
        action_times: when each action was taken, on the same clock. Then there may be any number of
            actions.
        channels: what three or four channels of `video` are; found out by default.
        facts: what else is known of the episode, for JSON: its task, …
    """

    video: NDArray[Any]
    actions: NDArray[Any]
    states: Mapping[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])
    times: NDArray[np.floating[Any]] | None = None
    action_times: NDArray[np.floating[Any]] | None = None
    channels: Channels | None = None
    facts: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def timed(self, name: str, fps: float | None) -> TimedRecording:
        """The same as a `TimedRecording`, with frames at a constant rate if it has no times.

        Raises:
            DataError: it has neither times nor a rate, or as many times as frames are not there.
        """
        video = np.asarray(self.video)
        if video.ndim < 3:
            raise DataError(f"video is {video.dtype} {video.shape}, not uint8 [T, H, W, 3]")
        if self.times is None:
            times = np.arange(len(video)) / (fps or 1.0)
        else:
            times = np.asarray(self.times, np.float64)
        if len(times) != len(video):
            raise DataError(f"it has {len(video)} frames and {len(times)} times")
        taken = None if self.action_times is None else np.asarray(self.action_times, np.float64)
        states = {name: Samples(np.asarray(rows)) for name, rows in self.states.items()}
        stamp = hashlib.sha256(np.ascontiguousarray(video).data).hexdigest()
        frames = ImageFrames(video, times, channels=self.channels, stamp=stamp)
        actions = Samples(np.asarray(self.actions), taken)
        return TimedRecording(name, {"video": frames}, actions, states, facts=self.facts)


class Recordings(Protocol):
    """Recordings by index, from 0: a list, or an object that opens them on request.

    To be sent to workers, it must be picklable, importable and small; one that knows a long list
    may have a method ``part(indices)``, which returns the same with what those recordings need. An
    error of ``__getitem__`` (a `DataError` or an `OSError`) counts as a defect of that recording.
    """

    def __len__(self) -> int:
        """Number of recordings."""
        ...

    def __getitem__(self, index: int, /) -> TimedRecording | Recording:
        """Open one recording; a `TimedRecording` without decoding its frames."""
        ...


@dataclass(frozen=True)
class ActionFacts:
    """What is known of the actions before they are read.

    Attributes:
        names: one per dimension; ``action_0``, … if it is empty.
        units: one per dimension; none if it is empty.
        kind: what an action commands; None if the source does not say it. They are held then, and
            if frames do not take all of them, the import asks.
        bounds: lower and upper bounds that are stated. None: those of the training episodes.
        widened: the training episodes widen the bounds; else an action beyond them is a defect.
        held: dimensions that are absolute whatever the kind is, such as a gripper's.
        ask: an unknown kind is likely not absolute, so nothing is resampled before it is stated.
    """

    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    kind: ActionKind | None = None
    bounds: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    widened: bool = False
    held: tuple[int, ...] = ()
    ask: bool = False

    def kinds(self, size: int) -> tuple[ActionKind, ...]:
        """The kind of each of `size` dimensions, or of all; none if it is not known."""
        if self.kind is None or not self.held:
            return (self.kind,) if self.kind else ()
        return tuple("absolute" if place in self.held else self.kind for place in range(size))


@dataclass(frozen=True)
class RecordedDataset:
    """What a format read: recordings to import.

    Attributes:
        name: the environment that they show, one word.
        splits: the recordings of each split; or all of them, if the source does not divide them, so
            that the last become test episodes.
        tests: which of recordings that are not divided are test episodes, if the source says so.
        facts: `kind` (the format) and `name` of what is imported, and what identifies it.
        fps: frames per second that the source states for all recordings.
        options: the format's own options, for the command that imports it again; None if no command
            does.
        actions: what is known of the actions.
        state: the states to keep; None keeps all that the first recording has.
        instances: names of the ids in masks, if recordings are labelled.
        size: frame size of a camera by default, as in `ImportOptions`.
        notes: sentences for people, kept in the card.
        seed: seed of the dataset, if the recordings were made with one.
        costly: opening a recording is as much work as reading it, e.g. because it is simulated. So
            each is opened once, and `fps` and the bounds of `actions` must be given.
        together: how many recordings, from a multiple of it on, are made at once when one of them
            is opened; one worker opens them.
        summary: one sentence about the data.
        engine: what made it.
        citation: its source.
    """

    name: str
    splits: Mapping[Split, Recordings] | Recordings
    facts: Mapping[str, Any]
    fps: float | None = None
    tests: Mapping[Split, Sequence[int]] | None = None
    options: Mapping[str, object] | None = None
    actions: ActionFacts = ActionFacts()
    state: tuple[StateField, ...] | None = None
    instances: tuple[str, ...] = ()
    size: int | tuple[int, int] | None = None
    notes: tuple[str, ...] = ()
    seed: int = 0
    costly: bool = False
    together: int = 1
    summary: str = ""
    engine: str = "recorded"
    citation: str = ""


def first_sound(paths: Sequence[Path], opens: Callable[[Path], object]) -> Path:
    """The first of some files that can be opened; the others become defects of their recordings.

    Raises:
        DataError: none can be; that of the first.
    """
    problem: DataError | None = None
    for path in paths:
        try:
            opens(path)
        except DataError as error:
            problem = problem or error
        else:
            return path
    raise problem or DataError("there are no files")
