"""Where one recording ends and the next begins, in arrays that hold several in a row."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError

Bounds = list[tuple[int, int]]
"""The first row of each episode and the row after its last."""

_WHOSE = (
    *("ep", "eps", "episode", "episodes", "traj", "trajs", "trajectory", "demo", "rollout"),
    *("trial", "take"),
)

_ALSO = (
    *("seq", "sequence", "path", "run", "clip", "game", "segment", "session", "recording"),
    *("scene", "video", "file"),
)


def _names(*parts: str) -> frozenset[str]:
    whose = (*_WHOSE, *_ALSO)
    return frozenset(f"{owner}_{part}" for owner, part in itertools.product(whose, parts))


LENGTHS = _names("len", "lens", "length", "lengths", "size", "sizes") | {"lengths"}
STARTS = _names("offset", "offsets", "start", "starts", "begin", "begins", "from")
ENDS = _names("end", "ends", "stop", "stops", "to")
EDGES = _names("bounds", "boundaries", "range", "ranges", "slices", "limits")
COUNTERS = frozenset(
    {"step", "step_idx", "step_index", "timestep", "timesteps", "time_step", "time_steps"}
    | {"frame", "frame_idx", "frame_index", "frame_id", "frame_number", "step_id", "step_no"}
    | {"episode_step", "ep_step"}
)
_CLOCK = re.compile(
    r"(sim_|ros_|wall_|elapsed_|relative_|header_)?(t|times?|timestamps?|stamp|seconds|elapsed)"
    r"(_?[(\[]?(s|secs?|seconds|m?sec|ms|us|usec|ns|nsec)[)\]]?)?"
)
"""Times of the rows, which begin anew with an episode; they may be a state as well."""
NUMBERS = _names("idx", "idxs", "index", "indices", "id", "ids", "num", "number", "no") | {
    *_WHOSE,
    *("trajectories", "sequence", "seq", "uuid", "file", "filename"),
}
LAST = frozenset(
    f"{name}{plural}"
    for name in ("terminal", "timeout", "done", "termination", "truncation", "is_last")
    for plural in ("", "s")
) | {"dones_float", "terminated", "truncated", "is_terminal", "last"}
FIRST = frozenset({"is_first", "first", "reset", "resets", "is_reset"})
STEP_TYPE = "step_type"
"""0 in the first row of an episode, as `dm_env` has it."""

_DEFINITE = (
    frozenset(
        name
        for name in LENGTHS | STARTS | ENDS | EDGES | NUMBERS
        if name.partition("_")[0] in (*_WHOSE, "lengths")
    )
    | FIRST
    | COUNTERS
    | {STEP_TYPE}
)
"""Names of arrays that may not contradict others: they mean episodes, and nothing within one."""

GOING_ON = frozenset(
    {"discount", "discounts", "continue", "continues", "not_done", "not_dones", "nonterminals"}
)
"""Flags that are 0 in the last row of an episode."""
INDEX = ("episode_data_index", "episodes", "episode", "meta")
"""Groups that say where episodes are, in which a name such as ``from`` is that of an episode."""


def plain(name: str) -> str:
    """The name of an array or column as the sets above have it."""
    return name.lower().strip().replace("-", "_").replace(" ", "_").replace(".", "_")


def divides(name: str) -> bool:
    """Whether an array of this name says where episodes begin or end, not what is in them."""
    return plain(name) in LENGTHS | STARTS | ENDS | EDGES


def is_clock(name: str) -> bool:
    """Whether an array of this name has the times of the rows, in whatever unit."""
    return _CLOCK.fullmatch(plain(name)) is not None


def tells(name: str) -> bool:
    """Whether an array of this name may tell episodes apart, in whatever way."""
    return divides(name) or plain(name) in NUMBERS | LAST | FIRST | COUNTERS | GOING_ON | {
        STEP_TYPE
    }


def may_tell(name: str, values: Any, count: int) -> bool:
    """Whether an array may tell episodes of `count` rows apart, by its name or by its content."""
    flat = values.ndim == 1 or (values.ndim == 2 and values.shape[1] in (1, 2))
    is_short = flat and 2 <= values.shape[0] < count and values.dtype.kind in "iu"
    return tells(name) or is_clock(name) or is_short


def bounds_of(
    candidates: Mapping[str, NDArray[Any]], count: int, where: str, *, flags: bool = True
) -> Bounds | None:
    """The episodes in `count` rows; None if no array says that there are several.

    Args:
        found: arrays that may say it, by name.
        count: number of rows.
        where: what holds them, for errors.
        flags: whether flags such as ``terminals`` end an episode; it ends at the last of a run.

    Raises:
        DataError: they contradict each other or the number of rows.
    """
    arrays = {plain(name): np.asarray(values) for name, values in candidates.items()}
    for name in [name for name in arrays if name in EDGES]:
        arrays |= _as_starts_and_ends(arrays.pop(name))
    arrays |= {name: ends for name, v in arrays.items() if (ends := _pairs(v, count)) is not None}
    flat = {name: v for name, v in arrays.items() if v.ndim == 1 or v.shape[1:] == (1,)}
    known = {name: v.reshape(-1) for name, v in flat.items() if v.dtype.kind in "biufSUO"}
    whole = {name: v for name, v in known.items() if v.dtype.kind in "iuf" and len(v)}
    edges = _edges(whole, count) or _runs(known, count, where)
    if edges is None and flags:
        ways = (_flagged(known, count), _counted(whole, count), _fitting(whole, count))
        edges = next((way for way in ways if way and len(way) > 1), None)  # flags may never be set
    if edges is None:
        return None
    ordered = sorted(edges)
    inside = ordered[0][0] >= 0 and ordered[-1][1] <= count
    apart = all(stop <= start for (_, stop), (start, _) in itertools.pairwise(ordered))
    if not (inside and apart and all(start < stop for start, stop in ordered)):
        raise DataError(f"the episodes that {where} names do not fit its {count} rows")
    if sum(stop - start for start, stop in ordered) != count:
        rows = sum(stop - start for start, stop in ordered)
        raise DataError(f"the episodes that {where} names have {rows} rows, and it has {count}")
    if len(candidates) > 1:
        check_agreement(candidates, edges, count, where, flags=flags)
    return edges if len(edges) > 1 else None


def check_agreement(
    candidates: Mapping[str, NDArray[Any]],
    edges: Bounds,
    count: int,
    where: str,
    *,
    flags: bool = True,
) -> None:
    """Refuse arrays of which one says other episodes than `edges`; arguments as in `bounds_of`.

    Flags of last rows may be set within an episode, as at a success, and so contradict nothing.

    Raises:
        DataError: one does; names it.
    """
    for name, values in candidates.items():
        says = plain(name)
        if says not in _DEFINITE and not is_clock(name):
            continue
        if not flags and says not in LENGTHS | STARTS | ENDS | EDGES | NUMBERS:
            continue
        ordered = np.sort(values) if says in STARTS | ENDS and values.ndim == 1 else values
        is_edge = says in LENGTHS | STARTS | ENDS | EDGES and len(values) < count
        own = bounds_of({name: ordered}, count, where) or ([(0, count)] if is_edge else edges)
        alike = {start for start, _ in edges} == {start for start, _ in own}
        if says in LENGTHS:  # in any order
            alike = sorted(b - a for a, b in own) == sorted(b - a for a, b in edges)
        if not alike:
            first, others = (", ".join(str(s) for s, _ in bounds[:4]) for bounds in (own, edges))
            raise DataError(
                f"{where} contradicts itself: by {name}, episodes begin in rows {first}, and by "
                f"the other arrays in rows {others}: remove what is wrong"
            )


def _as_starts_and_ends(edges: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Pairs of a first row and the row after the last, or all such rows in a list."""
    if edges.ndim == 2 and edges.shape[1] == 2:
        return {"episode_starts": edges[:, 0], "episode_ends": edges[:, 1]}
    if edges.ndim == 1 and len(edges) > 1 and edges[0] == 0:
        return {"episode_starts": edges[:-1], "episode_ends": edges[1:]}
    return {"episode_ends": edges}


def _pairs(values: NDArray[Any], count: int) -> NDArray[Any] | None:
    """Where episodes end, if each of some pairs of whole numbers begins where the last one ends."""
    if values.ndim != 2 or values.shape[1] != 2 or values.dtype.kind not in "iu" or not len(values):
        return None
    starts, ends = values.astype(np.int64).T
    after = ends + (ends[-1] == count - 1)  # of the last row, or after it
    fits = starts[0] == 0 and after[-1] == count and np.array_equal(starts[1:], after[:-1])
    return after if fits else None


def _edges(whole: Mapping[str, NDArray[Any]], count: int) -> Bounds | None:
    """Told by lengths, starts or ends."""
    lengths, starts, ends = (
        next((v.astype(np.int64) for name, v in whole.items() if name in names), None)
        for names in (LENGTHS, STARTS, ENDS)
    )
    if lengths is not None and (len(lengths) < count or starts is not None):
        first = np.cumsum(lengths) - lengths if starts is None else starts
        if len(first) == len(lengths):
            return list(zip(first.tolist(), (first + lengths).tolist(), strict=True))
    if ends is not None and len(ends) < count:
        stops = ends + 1 if int(ends.max()) == count - 1 else ends  # of the last row, or after it
        if starts is not None and len(starts) == len(ends):
            return list(zip(starts.tolist(), stops.tolist(), strict=True))
        return list(itertools.pairwise([0, *stops.tolist()]))
    if starts is not None and len(starts) < count:
        return list(itertools.pairwise([*starts.tolist(), count]))
    return None


def _runs(known: Mapping[str, NDArray[Any]], count: int, where: str) -> Bounds | None:
    """Told by a number or name of the episode in each row."""
    for name, values in known.items():
        if name not in NUMBERS or len(values) != count or not count:
            continue
        changes = np.flatnonzero(values[1:] != values[:-1]) + 1
        if len({*values.tolist()}) != len(changes) + 1:
            raise DataError(f"the rows of an episode are apart in {where}: sort them by {name}")
        return list(itertools.pairwise([0, *changes.tolist(), count]))
    return None


def _flagged(known: Mapping[str, NDArray[Any]], count: int) -> Bounds | None:
    """Told by flags of last or first rows."""
    flags = {n: v.astype(float) != 0 for n, v in known.items() if v.dtype.kind in "biuf"}
    last = [v for name, v in flags.items() if name in LAST and len(v) == count]
    last += [~v for name, v in flags.items() if name in GOING_ON and len(v) == count]
    first = [v for name, v in flags.items() if name in FIRST and len(v) == count]
    first += [~v for name, v in flags.items() if name == STEP_TYPE and len(v) == count]
    if first:
        starts = np.flatnonzero(first[0])
        return list(itertools.pairwise([0, *starts[starts > 0].tolist(), count]))
    if last and count:
        ended = np.any(last, axis=0)
        stops = np.flatnonzero(ended & ~np.append(ended[1:], False)) + 1
        return list(itertools.pairwise([0, *stops[stops < count].tolist(), count]))
    return None


def _counted(whole: Mapping[str, NDArray[Any]], count: int) -> Bounds | None:
    """Told by a number of the row in its episode, or by its time there, which begin anew."""
    for name, values in whole.items():
        if (name in COUNTERS or is_clock(name)) and len(values) == count > 1:
            steps = np.diff(values.astype(np.float64))
            usual = 1.0 if name in COUNTERS else float(np.median(steps))
            starts = np.flatnonzero(steps != 1 if name in COUNTERS else steps <= 0) + 1
            if usual > 0 and (np.abs(values[starts] - values[0]) < usual / 2).all():
                return list(itertools.pairwise([0, *starts.tolist(), count]))
    return None


def _fitting(whole: Mapping[str, NDArray[Any]], count: int) -> Bounds | None:
    """Told by whole numbers, fewer than the rows, that are lengths of episodes or where they end.

    Their name is not known, but they add up to the number of rows, or grow to it.
    """
    for values in (v.astype(np.int64) for v in whole.values() if v.dtype.kind in "iu"):
        if not 2 <= len(values) < count or values.min() < 0:
            continue
        edges = np.cumsum(values) if values.sum() == count else values
        edges = edges[1:] if edges[0] == 0 else edges
        if edges[-1] == count and len(edges) > 1 and (np.diff(edges) > 0).all():
            return list(itertools.pairwise([0, *edges.tolist()]))
    return None
