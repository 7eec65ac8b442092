"""Brings frames, actions and states of a recording together by their times.

Everything is a stream: samples with increasing times. A grid of moments is laid over the frames, at
their own rate or at the one that is asked for, and every stream is looked up on it. What has no
times is given those of the frames that it belongs to. Whatever disagrees becomes a `Defect`.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.card import ActionKind
from acwm_core.errors import DataError
from acwm_formats.cadence import JITTER, SAME, Cadence, cadence, faults
from acwm_formats.frames import MOST_FRAMES
from acwm_formats.timeline import Frames, Samples, TimedRecording

OnDefect = Literal["refuse", "skip", "trim"]

LOST = 0.2  # share of regular actions that may be missing; with more, their rhythm is another
UNUSED = 0.01  # share of the actions that may be at no frame without a word: clocks differ

TRIM, GAP = "--on-defect trim", "--max-gap or --on-defect trim"


@dataclass(frozen=True)
class Alignment:
    """How recordings are aligned.

    Attributes:
        fps: frames per second to resample to; by default frames are taken as they are.
        tolerance: by how much of a frame interval times may be off.
        max_gap: how many missing frames or actions in a row are filled with what was before; as
            many are left out at either end.
        shift: by how many frames actions are moved; a positive number moves them to later frames.
        kinds: what each dimension of the actions commands, or all of them, as the recordings say
            by default. It decides what becomes
            of actions between two frames: they are held, averaged or summed.
        on_defect: what becomes of a recording with a defect. ``trim`` keeps its sound parts.
    """

    fps: Fraction | None = None
    tolerance: float = 0.25
    max_gap: int = 2
    shift: int = 0
    kinds: tuple[ActionKind, ...] = ()
    on_defect: OnDefect = "refuse"


class Defect(NamedTuple):
    """Something about a recording that cannot be taken as it is.

    Attributes:
        episode: the name of the recording.
        problem: what disagrees, with the numbers.
        option: the option of the import that decides about it; empty if none does.
    """

    episode: str
    problem: str
    option: str = ""

    def __str__(self) -> str:
        """One line."""
        return f"{self.episode}: {self.problem}" + (f" ({self.option})" if self.option else "")


class PlannedEpisode(NamedTuple):
    """What becomes one episode of T frames.

    Attributes:
        frames: for each camera ``[T]``, the place of each frame in its `Frames`.
        actions: ``[T, A]`` float32; row i leads from frame i to frame i + 1, and the last is zero.
        states: ``[T, …]`` by name.
    """

    frames: Mapping[str, NDArray[np.int64]]
    actions: NDArray[np.float32]
    states: Mapping[str, NDArray[Any]]


@dataclass
class Aligned:
    """A recording after alignment.

    Attributes:
        episodes: what becomes of it: one episode, or several sound parts, or none.
        defects: what is wrong with it; `episodes` are its sound parts then.
        notes: what was filled or left out, for people; `name` says of which recording.
        per_frame: actions per frame of the episodes; 1 if every frame takes one of its own.
        unused: share of the actions that are at no frame, as others come before the next frame.
        rate: measured frames per second of its frames; 0 if unknown.
        seconds: how long they were measured.
    """

    name: str
    episodes: list[PlannedEpisode] = field(default_factory=list[PlannedEpisode])
    defects: list[Defect] = field(default_factory=list[Defect])
    notes: list[str] = field(default_factory=list[str])
    per_frame: float = 1.0
    unused: float = 0.0
    rate: float = 0.0
    seconds: float = 0.0

    def add_defect(self, problem: str, option: str = TRIM) -> None:
        """Add a defect."""
        self.defects.append(Defect(self.name, problem, option))


class _Samples(NamedTuple):
    """Samples with increasing times: values, or the places of frames."""

    times: NDArray[np.float64]
    values: NDArray[Any]

    @property
    def step(self) -> float:
        """The usual time from one sample to the next."""
        return float(np.median(np.diff(self.times))) if len(self.times) > 1 else 0.0


class _Grid(NamedTuple):
    """The moments of the frames to be, `step` seconds apart."""

    times: NDArray[np.float64]
    step: float


def align(recording: TimedRecording, cameras: Sequence[str], options: Alignment) -> Aligned:
    """Plan the episodes of a recording.

    Args:
        recording: what a format read.
        cameras: those to show; the first one gives the moments.
        options: how.
    """
    aligned = Aligned(recording.name, notes=[*recording.notes])
    try:
        frames = {name: _frame_stream(aligned, name, recording.cameras[name]) for name in cameras}
        main = _claimed(aligned, frames[cameras[0]], recording, options)
        frames[cameras[0]] = main
        if len(main.times) < 2:
            aligned.add_defect(
                f"it has {len(main.times)} usable frames, and an action needs the next one", ""
            )
            return aligned
        seconds = float(main.times[-1] - main.times[0])
        _check_span(seconds, 1 / main.step)
        _check_span(seconds, float(options.fps or 0))
        measured = cadence(main.times)
        aligned.rate, aligned.seconds = measured.rate, float(main.times[-1] - main.times[0])
        said = _compare(aligned, recording, measured, options)
        grid = _grid(aligned, main, measured, options)
        rows = _Rows(aligned, main.times, measured)
        actions = rows.stream("action", _rows_of(recording.actions), last=False)
        states = {n: rows.stream(n, samples) for n, samples in recording.states.items()}
        grid = _Grid(grid.times[grid.times < main.times[said]], grid.step) if said else grid
        _plan(aligned, grid, frames, actions, states, options)
    except DataError as error:
        aligned.episodes.clear()
        aligned.add_defect(str(error), "")
    return aligned


def _check_span(seconds: float, rate: float) -> None:
    """Refuse times of which one is so far off that the frames between would fill the memory."""
    if not seconds * rate <= MOST_FRAMES:
        raise DataError(
            f"its frames span {seconds:.4g} s, and at {rate:.4g} frames/s that is more "
            f"than {MOST_FRAMES:,}: a time is wrong, or in another unit"
        )


def _frame_stream(aligned: Aligned, name: str, frames: Frames) -> _Samples:
    times = frames.times
    return _sound(aligned, f"camera {name}", _Samples(times, np.arange(len(times))))


def _claimed(
    aligned: Aligned, frames: _Samples, recording: TimedRecording, options: Alignment
) -> _Samples:
    """The frames without a few beyond those that the source claims: video files often end late."""
    length, numbers = recording.length or 0, recording.actions.frames
    spare = len(frames.times) - length if length else 0
    has_rows = numbers is not None and len(numbers) > 0 and np.max(numbers) >= length
    if has_rows or not 0 < spare <= options.max_gap:
        return frames
    aligned.notes.append(f"its last {spare} frames, which have no row, were left out")
    return _Samples(frames.times[:length], frames.values[:length])


def _sound(aligned: Aligned, what: str, stream: _Samples) -> _Samples:
    """The stream without samples whose times are missing or do not increase; notes report them."""
    kept, problems = faults(stream.times)
    for problem in problems:
        aligned.add_defect(f"{what}: {problem}")
    return _Samples(stream.times[kept], stream.values[kept])


def _compare(
    aligned: Aligned, recording: TimedRecording, measured: Cadence, options: Alignment
) -> int | None:
    """Compare what the source claims with what its frames show; says how many of them count."""
    said, count, slots = recording.length, len(measured.slots), measured.places
    if said is not None and said not in (count, slots, slots + measured.late):
        aligned.add_defect(f"it claims {said} frames, but has {count}")
    if recording.rate and options.fps is None and not measured.is_at(recording.rate):
        rates = f"{float(recording.rate):g} frames/s, but has {measured.rate:.4g}"
        aligned.add_defect(f"it claims {rates}", "--fps")
    return said if said is not None and 2 <= said < count else None


def _grid(aligned: Aligned, frames: _Samples, measured: Cadence, options: Alignment) -> _Grid:
    if options.fps is not None and not measured.is_at(options.fps):
        step = 1 / float(options.fps)
        length = frames.times[-1] - frames.times[0] + measured.step
        count = int(np.ceil(length / step - options.tolerance * measured.step / step))
        return _Grid(frames.times[0] + step * np.arange(count), step)
    if measured.irregular and options.fps is None:
        aligned.add_defect(f"its frame rate is not constant: {measured.irregular}", "--fps")
    moments = np.arange(measured.places)
    return _Grid(np.interp(moments, measured.slots, frames.times), measured.step)


class _Rows:
    """Gives rows of numbers the times of the frames that they belong to.

    Frames are counted in two ways: as they are, and with those that were lost.
    """

    def __init__(self, aligned: Aligned, times: NDArray[np.float64], measured: Cadence) -> None:
        self._aligned, self._measured = aligned, measured
        whole = np.arange(-measured.late, measured.places)
        steps = times[0] + measured.step * whole
        self._slots = np.where(
            whole < 0, steps, np.interp(np.maximum(whole, 0), measured.slots, times)
        )
        self._late, self._frames = measured.late, times

    def stream(self, name: str, samples: Samples, *, last: bool = True) -> _Samples:
        """The samples of `name` as a stream; without `last`, the last frame needs no row."""
        values = _numbers(name, samples.values)
        if not last and samples.times is None and len(values) > 1:
            kept = slice(None if _finite(values[-1:]).all() else -1)  # it leads to no frame
            frames = None if samples.frames is None else samples.frames[kept]
            values = values[kept]
            samples = Samples(values, frames=frames)
        if not len(values):
            raise DataError(f"{name} has 0 rows")
        if samples.times is not None:
            times = np.asarray(samples.times, np.float64)
            if len(times) != len(values):
                raise DataError(f"{name} has {len(values)} rows and {len(times)} times")
        else:
            times, values = self._placed(name, samples, values, last)
        stream = _sound(self._aligned, name, _Samples(times, values))
        finite = _finite(stream.values)
        if not finite.all():
            row, column = np.argwhere(~finite)[0]
            self._aligned.add_defect(f"{name} is not finite in row {row}, dimension {column}")
            stream = _Samples(stream.times[finite.all(1)], stream.values[finite.all(1)])
        if not len(stream.times):
            raise DataError(f"{name} has no usable row")
        return stream

    def _placed(
        self, name: str, samples: Samples, values: NDArray[Any], last: bool
    ) -> tuple[NDArray[np.float64], NDArray[Any]]:
        numbers = np.arange(len(values))
        if samples.frames is not None:
            numbers = np.asarray(samples.frames, np.int64)
            if len(numbers) != len(values):
                raise DataError(
                    f"{name} has {len(values)} rows and {len(numbers)} numbers of frames"
                )
            if len(numbers) and (numbers.min() < 0 or np.any(np.diff(numbers) < 0)):
                self._aligned.add_defect(f"{name}: the numbers of frames go back")
                numbers = np.maximum.accumulate(np.maximum(numbers, 0))
        places = self._places(name, int(numbers[-1]) + 1 if len(numbers) else 0, last)
        inside = numbers < len(places)
        return places[numbers[inside]], values[inside]

    def _places(self, name: str, count: int, last: bool) -> NDArray[np.float64]:
        """The times of frames that are counted up to `count`."""
        ways = [self._frames, self._slots[self._late :], self._slots]
        for places in (*ways, *([] if last else [way[:-1] for way in ways])):
            if len(places) == count:
                return places
        self._aligned.add_defect(
            f"{name} has {count} rows, and the video {len(self._frames)} frames"
        )
        return self._slots[self._late :]


def _finite(values: NDArray[Any]) -> NDArray[np.bool_]:
    return np.isfinite(values.reshape(len(values), -1).astype(np.float64))


def _rows_of(actions: Samples) -> Samples:
    values = np.asarray(actions.values)
    if values.ndim == 1:
        values = values[:, None]
    if values.ndim != 2:
        raise DataError(f"actions are {values.shape}, not [N, A]")
    return replace(actions, values=values)


def _numbers(name: str, values: NDArray[Any]) -> NDArray[Any]:
    array = np.asarray(values)
    if array.dtype.kind not in "fiub" or array.ndim == 0:
        raise DataError(f"{name} holds {array.dtype}, not numbers")
    return array


def _plan(
    aligned: Aligned,
    grid: _Grid,
    frames: Mapping[str, _Samples],
    actions: _Samples,
    states: Mapping[str, _Samples],
    options: Alignment,
) -> None:
    """Look all streams up on the grid, and cut it where one of them has nothing."""
    chosen = {
        name: _held(aligned, f"camera {name}", s, grid, options) for name, s in frames.items()
    }
    taken, acting = _acted(aligned, actions, grid, options)
    seen = {name: _held(aligned, name, stream, grid, options) for name, stream in states.items()}
    whole = np.ones(len(grid.times), bool)
    for _, known in (*chosen.values(), *seen.values()):
        whole &= known
    acting[-1] = True  # it leads to no frame
    runs = _runs(whole, acting)
    _tell_cuts(aligned, grid, runs, options)
    for start, stop in runs:
        part = slice(start, stop)
        rows = taken[part].astype(np.float32)
        rows[-1] = 0
        aligned.episodes.append(
            PlannedEpisode(
                {name: values[part] for name, (values, _) in chosen.items()},
                rows,
                {name: values[part] for name, (values, _) in seen.items()},
            )
        )


def _runs(whole: NDArray[np.bool_], acting: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Runs of frames that are there, each with an action to the next; of two frames at least."""
    runs: list[tuple[int, int]] = []
    start = None
    for index, there in enumerate(whole):
        if there and start is None:
            start = index
        if start is not None and not (there and acting[index]):
            runs.append((start, index + bool(there)))
            start = None
    if start is not None:
        runs.append((start, len(whole)))
    return [(start, stop) for start, stop in runs if stop - start >= 2]


def _tell_cuts(
    aligned: Aligned, grid: _Grid, runs: Sequence[tuple[int, int]], options: Alignment
) -> None:
    """Tell what lies outside the runs; more than a few frames are a defect."""
    if not runs:
        aligned.add_defect("frames, actions and states overlap in fewer than two moments", "")
        return
    count, known = len(grid.times), bool(aligned.defects)
    first = runs[0][0] - max(options.shift, 0)  # a shift leaves out as many, as it was asked to
    last = count - runs[-1][1] - max(-options.shift, 0)
    for missing, where in ((first, "first"), (last, "last")):
        if missing > options.max_gap and not known:
            aligned.add_defect(
                f"its {where} {missing} of {count} frames lack actions, states or a camera"
            )
        elif missing > 0:
            aligned.notes.append(f"its {where} {missing} of {count} frames were left out")
    for (_, stop), (start, _) in itertools.pairwise(runs):
        seconds = grid.times[start] - grid.times[stop - 1]
        aligned.add_defect(f"frames or actions are missing for {seconds:.3g} s", GAP)


def _held(
    aligned: Aligned, name: str, stream: _Samples, grid: _Grid, options: Alignment
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """The latest sample at each moment, and whether there is one."""
    step = stream.step or grid.step
    slack = options.tolerance * min(grid.step, step)
    last = len(stream.times) - 1
    place = np.searchsorted(stream.times, grid.times + slack, side="right") - 1
    before = np.maximum(place, 0)
    due = grid.times - stream.times[before] >= step - slack  # another sample should be there
    hole = stream.times[np.minimum(before + 1, last)] - stream.times[before] - step
    lost = due & (place < last) & (hole > step / 2)
    known = (place >= 0) & ((place < last) | ~due)
    known &= ~lost | (hole <= options.max_gap * grid.step + slack)
    if filled := int(np.sum(lost & known)):
        aligned.notes.append(f"{filled} missing of {name} were filled with the previous value")
    return stream.values[before], known


def _acted(
    aligned: Aligned, actions: _Samples, grid: _Grid, options: Alignment
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """The action from each moment to the next, and whether there is one."""
    taken, known = _held(aligned, "action", actions, grid, options)
    taken = taken.astype(np.float64)
    aligned.per_frame, aligned.unused = _per_frame(actions, grid, options.tolerance)
    step = actions.step or grid.step
    differs = abs(step / grid.step - 1) > SAME + options.tolerance / len(grid.times)
    if aligned.unused or differs:
        kinds = options.kinds or ("absolute",)
        kinds = kinds * (taken.shape[1] if len(kinds) == 1 else 1)
        if len(kinds) != taken.shape[1]:
            raise DataError(f"its actions have {taken.shape[1]} dimensions, not {len(kinds)}")
        rates = np.array([kind in ("velocity", "torque") for kind in kinds])
        deltas = np.array([kind == "delta" for kind in kinds])
        ends = np.append(actions.times, actions.times[-1] + step)
        values = actions.values.astype(np.float64)
        seconds = np.diff(ends)[:, None]
        taken[:, rates] = _summed(values[:, rates] * seconds, ends, grid) / grid.step
        taken[:, deltas] = _summed(values[:, deltas] * _counts(actions), ends, grid)
        if rates.any() or deltas.any():  # a sum needs the whole interval
            slack = options.tolerance * grid.step
            known &= grid.times + grid.step <= ends[-1] + slack
    if options.shift:
        taken, known = np.roll(taken, options.shift, axis=0), np.roll(known, options.shift)
        known[: max(options.shift, 0)] = False
        known[len(known) + min(options.shift, 0) :] = False
    return taken, known


def _per_frame(actions: _Samples, grid: _Grid, tolerance: float) -> tuple[float, float]:
    """Actions per moment of the grid, and the share that is at none of them.

    They are 1 and 0 if, but for the error of clocks, each moment has its own.
    """
    step = actions.step or grid.step
    slack = tolerance * min(grid.step, step)
    edges = np.append(grid.times, grid.times[-1] + grid.step) - slack
    counts = np.histogram(actions.times, edges)[0]
    first, last = np.searchsorted(edges, actions.times[[0, -1]], side="right") - 1
    counts = counts[max(first, 0) : max(last, 0)]  # not where actions begin or end
    unused = int(np.maximum(counts - 1, 0).sum())
    if unused > max(1, UNUSED * counts.sum()):
        return float(counts.mean()), unused / float(counts.sum())
    empty = int((counts == 0).sum())
    slow = step / grid.step > 1 + SAME + tolerance / len(grid.times)
    return (grid.step / step if slow and empty > 1 else 1.0), 0.0


def _counts(actions: _Samples) -> NDArray[np.float64]:
    """How many actions each sample stands for ``[N, 1]``: more than one if the next were lost."""
    steps = np.diff(actions.times) / (actions.step or 1.0)
    places = np.rint(steps)
    regular = len(steps) and np.abs(steps - places).max() <= JITTER
    few = places.sum() <= (1 + LOST) * len(places)
    return np.append(places if regular and few else np.ones(len(steps)), 1.0)[:, None]


def _summed(
    values: NDArray[np.float64], ends: NDArray[np.float64], grid: _Grid
) -> NDArray[np.float64]:
    """Sums over each interval of the grid of values that are spread evenly until the next one."""
    total = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])
    edges = np.append(grid.times, grid.times[-1] + grid.step)
    at = [np.interp(edges, ends, column) for column in total.T]
    return np.diff(np.array(at).reshape(len(at), len(edges)), axis=1).T
