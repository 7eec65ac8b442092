"""Reads all recordings of a dataset: cameras, sizes, states, alignment, and checks."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.card import ActionSpec, StateField, out_of_bounds
from acwm_core.env.episode import Split
from acwm_core.errors import AcwmError, DataError, suggest
from acwm_core.evaluation.statistics import MIN_EPISODES
from acwm_core.executors import Report
from acwm_formats.alignment import Aligned, Alignment, Defect, PlannedEpisode, align
from acwm_formats.sizes import shrunk, target_size
from acwm_formats.timeline import RecordedDataset, Recording, Recordings, TimedRecording

Bounds = Literal["range", "quantile"] | tuple[tuple[float, ...], tuple[float, ...]]
"""How bounds are found; or the lower and the upper ones, of each dimension or one for all."""


@dataclass(frozen=True)
class ImportOptions:
    """What a user decides about an import, whatever the format.

    Attributes:
        size: frame size of a camera, a side or ``(H, W)``; larger frames are averaged down. By
            default that of the first recording, each side rounded down to a multiple of 8.
        cameras: which cameras to show, side by side; by default the first one that has colours.
        depth_range: distances in metres that become white and black in depth maps.
        environment: name of the environment, instead of the one that the format gives.
        test_episodes: how many of the last recordings become `ind_test`, if the source has no test
            episodes; a tenth by default, and at least the five that a verdict takes (of fewer than
            ten recordings two).
        bounds: whether the bounds of actions are the range of the training episodes, or the range
            without the outermost hundredth at either end; or the bounds themselves, as of earlier
            recordings of the same robot. All actions are cut to them.
        alignment: how frames and actions are brought together.
    """

    size: int | tuple[int, int] | None = None
    cameras: tuple[str, ...] = ()
    depth_range: tuple[float, float] | None = None
    environment: str | None = None
    test_episodes: int | None = None
    bounds: Bounds = "range"
    alignment: Alignment = field(default_factory=Alignment)

    def __post_init__(self) -> None:
        if self.depth_range and not 0 <= self.depth_range[0] < self.depth_range[1]:
            near, far = self.depth_range
            raise DataError(f"--depth-range {near:g},{far:g}: give a nearer and a farther distance")
        for low, high in zip(*self.bounds, strict=True) if isinstance(self.bounds, tuple) else ():
            if not -math.inf < low < high < math.inf:
                raise DataError(f"--bounds {low:g},{high:g}: give a lower and a higher number")


@dataclass(frozen=True)
class CommonReading:
    """What the recordings of a dataset have in common.

    Attributes:
        cameras: those to show, from left to right.
        recorded_size: size of the frames of the first camera.
        size: frame size of every camera in the dataset.
        resized: whether the size was asked for, so that frames of other sizes become it too.
        depth_range: as in `ImportOptions`.
        alignment: as in `ImportOptions`.
        fps: rate that the source states.
        state: the states to keep.
        action: names and units of the actions; their bounds if these are `stated`, else any.
        stated: whether actions beyond the bounds are a defect.
        instances: names of the ids in masks; none if masks are not taken.
    """

    cameras: tuple[str, ...]
    recorded_size: tuple[int, int]
    size: tuple[int, int]
    resized: bool
    depth_range: tuple[float, float] | None
    alignment: Alignment
    fps: float | None
    state: tuple[StateField, ...]
    action: ActionSpec
    stated: bool
    instances: tuple[str, ...] = ()

    def planned(self, recording: TimedRecording) -> Aligned:
        """Align a recording and check it against what all have in common."""
        missing = [name for name in self.cameras if name not in recording.cameras]
        if missing:
            return _refused(recording.name, f"it has no camera {missing[0]}")
        try:
            sizes = [recording.cameras[name].size for name in self.cameras]
        except (AcwmError, OSError) as error:
            return _refused(recording.name, str(error))
        given = {name: recording.states[name] for name in self._state_names(recording)}
        aligned = align(replace(recording, states=given), self.cameras, self.alignment)
        for size in sizes:
            self._check_size(aligned, size)
        for episode in aligned.episodes:
            self._check_numbers(aligned, episode)
        return aligned

    def _state_names(self, recording: TimedRecording) -> list[str]:
        return [field.name for field in self.state if field.name in recording.states]

    def _check_size(self, aligned: Aligned, size: tuple[int, int]) -> None:
        if size == self.recorded_size:
            return
        if not self.resized:
            first = "×".join(map(str, self.recorded_size))
            shapes = f"{size[0]}×{size[1]}, and those of the first {first}"
            aligned.add_defect(f"its frames are {shapes}", "--size")
        elif size[0] < self.size[0] or size[1] < self.size[1]:
            aligned.add_defect(f"its frames of {size[0]}×{size[1]} cannot be enlarged", "--size")
            aligned.episodes.clear()

    def _check_numbers(self, aligned: Aligned, episode: PlannedEpisode) -> None:
        size = episode.actions.shape[1]
        if size != self.action.size:
            aligned.add_defect(f"its actions have {size} dimensions, not {self.action.size}", "")
            aligned.episodes.clear()
            return
        if self.stated and (beyond := out_of_bounds(episode.actions[:-1], self.action)):
            aligned.add_defect(beyond, "")
            aligned.episodes.clear()
            return
        for wanted in self.state:
            shape = episode.states[wanted.name].shape[1:] if wanted.name in episode.states else None
            if shape != wanted.shape:
                aligned.add_defect(f"the state {wanted.name} is {shape}, not {wanted.shape}", "")
                aligned.episodes.clear()
                return

    def frames(
        self, recording: TimedRecording, episode: PlannedEpisode
    ) -> Iterator[NDArray[np.uint8]]:
        """Decode the frames of an episode, all cameras side by side."""
        streams = [
            recording.cameras[name].read(episode.frames[name].tolist(), self.depth_range)
            for name in self.cameras
        ]
        for views in zip(*streams, strict=True):
            yield np.concatenate([shrunk(view, self.size) for view in views], axis=1)

    def key(self, recording: TimedRecording, episode: PlannedEpisode) -> str:
        """What identifies an episode as it is read, but for the pixels of its files."""
        digest = hashlib.sha256(repr((self.size, self.cameras, self.depth_range)).encode())
        digest.update(recording.name.encode())
        for array in (*episode.frames.values(), episode.actions, *episode.states.values()):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def _refused(name: str, problem: str) -> Aligned:
    return Aligned(name, defects=[Defect(name, problem)])


def opened(recordings: Recordings, index: int, name: str, fps: float | None) -> TimedRecording:
    """Open a recording; one of arrays gets the name.

    Raises:
        DataError: it cannot be read.
    """
    try:
        recording = recordings[index]
        return recording.timed(name, fps) if isinstance(recording, Recording) else recording
    except (AcwmError, OSError) as error:
        raise DataError(str(error)) from error


@dataclass(frozen=True)
class ScanTask:
    """Recordings of one split to look at."""

    recordings: Recordings
    split: Split
    indices: tuple[int, ...]
    reading: CommonReading
    sampled: int  # most rows of actions to return of each


@dataclass(frozen=True)
class Scan:
    """What a look at the times and numbers of a recording tells, before a frame is decoded.

    Attributes:
        index: its place among the recordings of its split.
        name: its name.
        lengths: number of frames of each episode that it becomes.
        defects: what is wrong with it.
        notes: what was filled or left out.
        rate: frames per second, 0 if unknown.
        seconds: how long it is.
        per_frame, unused: actions per frame, and the share at no frame, as in `Aligned`.
        actions: rows of its actions ``[N, A]``: evenly chosen ones, and the least and the greatest.
        keys: what identifies each episode, see `CommonReading.key`.
    """

    split: Split
    index: int
    name: str
    lengths: tuple[int, ...] = ()
    defects: tuple[Defect, ...] = ()
    notes: tuple[str, ...] = ()
    rate: float = 0.0
    seconds: float = 0.0
    per_frame: float = 1.0
    unused: float = 0.0
    actions: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    keys: tuple[str, ...] = ()

    @classmethod
    def of_defect(cls, split: Split, index: int, name: str, problem: str) -> Scan:
        """The scan of a recording that cannot be read."""
        return cls(split, index, name, defects=(Defect(name, problem),))


def scan(task: ScanTask, report: Report) -> list[Scan]:
    """Look at the times and numbers of recordings; reports each."""
    scans: list[Scan] = []
    for index in task.indices:
        name = episode_name(task.split, index)
        try:
            recording = opened(task.recordings, index, name, task.reading.fps)
            aligned = task.reading.planned(recording)
        except DataError as error:
            scans.append(Scan.of_defect(task.split, index, name, str(error)))
        else:
            keys = tuple(task.reading.key(recording, episode) for episode in aligned.episodes)
            scans.append(scanned(task.split, index, aligned, task.sampled, keys))
        report(1)
    return scans


def scanned(
    split: Split, index: int, aligned: Aligned, sampled: int, keys: tuple[str, ...]
) -> Scan:
    """The `Scan` of an aligned recording."""
    rows = [episode.actions[:-1] for episode in aligned.episodes]
    return Scan(
        split,
        index,
        aligned.name,
        tuple(len(episode.actions) for episode in aligned.episodes),
        tuple(aligned.defects),
        tuple(aligned.notes),
        aligned.rate,
        aligned.seconds,
        aligned.per_frame,
        aligned.unused,
        _sample(np.concatenate(rows), sampled) if rows else np.zeros((0, 0), np.float32),
        keys,
    )


def _sample(rows: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    if len(rows) <= count:
        return rows
    chosen = rows[np.linspace(0, len(rows) - 1, count).astype(int)]
    return np.concatenate([chosen, rows.min(0)[None], rows.max(0)[None]])


def episode_name(split: str, index: int) -> str:
    """The name of a recording that has none of its own."""
    return f"episode {index} of {split}"


def common_reading(
    recorded: RecordedDataset, first: TimedRecording, options: ImportOptions
) -> CommonReading:
    """What the recordings have in common, told by the first one.

    Raises:
        DataError: it has no such camera or state, or its frames are too small.
        ShapeError: the size is not possible.
    """
    cameras = _cameras(first, options)
    recorded_size = first.cameras[cameras[0]].size
    size = target_size(recorded_size, options.size or recorded.size)
    states = recorded.state
    if states is None:
        shapes = {name: np.shape(rows.values)[1:] for name, rows in first.states.items()}
        states = tuple(StateField(n, shape, "", "as recorded") for n, shape in shapes.items())
    elif missing := [field.name for field in states if field.name not in first.states]:
        hint = suggest(missing[0], first.states)
        raise DataError(f"recordings have no state {missing[0]!r}{hint}")
    return CommonReading(
        cameras,
        recorded_size,
        size,
        bool(options.size or recorded.size),
        options.depth_range,
        options.alignment,
        recorded.fps,
        states,
        _action(recorded, np.shape(first.actions.values)),
        not isinstance(options.bounds, tuple)
        and recorded.actions.bounds is not None
        and not recorded.actions.widened,
        recorded.instances if size == recorded_size and len(cameras) == 1 else (),
    )


def _cameras(first: TimedRecording, options: ImportOptions) -> tuple[str, ...]:
    if not first.cameras:
        raise DataError("the recordings have no camera, but a world model predicts video")
    for name in options.cameras:
        if name not in first.cameras:
            raise DataError(f"there is no camera {name!r}{suggest(name, first.cameras)}")
    if options.cameras:
        return options.cameras
    coloured = (name for name, frames in first.cameras.items() if not frames.depth)
    return (next(coloured, next(iter(first.cameras))),)


def _action(recorded: RecordedDataset, shape: Sequence[int]) -> ActionSpec:
    facts, size = recorded.actions, shape[1] if len(shape) > 1 else 1
    names = facts.names if facts.names else tuple(f"action_{i}" for i in range(size))
    if len(names) != size:
        raise DataError(f"{len(names)} names are given for {size} dimensions of the actions")
    low, high = facts.bounds or ((-1.0,) * size, (1.0,) * size)
    return ActionSpec(names, facts.units or ("",) * size, low, high, facts.kind or "absolute")


def divided(
    recorded: RecordedDataset, test_episodes: int | None
) -> dict[Split, tuple[Recordings, Sequence[int]]]:
    """The recordings of each split, and the places in them of those that belong to it.

    Raises:
        DataError: as many episodes cannot be set aside for tests.
    """
    if isinstance(recorded.splits, Mapping):
        if test_episodes is not None:
            raise DataError("--test-episodes: these recordings are divided into splits already")
        return {s: (r, range(len(r))) for s, r in recorded.splits.items() if len(r)}
    recordings, count = recorded.splits, len(recorded.splits)
    if test_episodes is None and recorded.tests:
        tests = {number for numbers in recorded.tests.values() for number in numbers}
        own: dict[Split, Sequence[int]] = {
            "train": [i for i in range(count) if i not in tests],
            **recorded.tests,
        }
        return {split: (recordings, part) for split, part in own.items() if len(part)}
    if test_episodes is None:
        test_episodes = _tests(count)
    if count and not 0 <= test_episodes < count:
        raise DataError(f"{test_episodes} of {count} episodes cannot be set aside for tests")
    first = count - test_episodes
    parts: dict[Split, range] = {"train": range(first), "ind_test": range(first, count)}
    return {split: (recordings, part) for split, part in parts.items() if len(part)}


def _tests(count: int) -> int:
    """How many of the recordings become test episodes, if nobody says it."""
    if count < 2 * MIN_EPISODES:
        return 2 if count > 2 else 0
    return max(MIN_EPISODES, count // 10)


def stated_rates(recorded: RecordedDataset, first: TimedRecording) -> list[Fraction]:
    """Rates that are stated somewhere."""
    known = [recorded.fps, first.rate]
    return [Fraction(rate).limit_denominator(100_000) for rate in known if rate]
