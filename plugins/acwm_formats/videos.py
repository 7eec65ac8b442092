"""The format of who has none: a folder of videos, with a table of actions beside each."""

from __future__ import annotations

import functools
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError, suggest
from acwm_formats.episode_bounds import bounds_of, is_clock, tells
from acwm_formats.example import write_example_videos
from acwm_formats.format import Format
from acwm_formats.frames import ImageFrames, VideoFrames, file_stamp, regular_times, video_index
from acwm_formats.names import composed, exact, folded, is_action, word, words
from acwm_formats.picture_names import keys, numbered, title, told_apart
from acwm_formats.sources import VIDEOS, damage_of, files_in, guarded
from acwm_formats.tables import (
    FRAMES,
    READERS,
    TIMES,
    Table,
    action_columns,
    episode_column,
    holds_numbers,
    number_column,
    numbers,
    read_table,
    seconds,
    special_column,
)
from acwm_formats.texts import text_facts, text_note
from acwm_formats.timeline import (
    ActionFacts,
    Frames,
    RecordedDataset,
    Samples,
    TimedRecording,
    first_sound,
)

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")


class VideoEpisode(NamedTuple):
    """Where one episode lies.

    Attributes:
        name: the name of its video or folder, without an ending.
        cameras: a video file, or a folder of pictures, by the name of the camera.
        table: the file with its actions; None if there is none, or one for all.
        tables: names of several that could be it.
        begins: the part of its pictures' names that has its number, if a folder holds several
            episodes.
        rows: its first row, the row after its last and the number of all, in a table for all whose
            rows belong to pictures by their place.
    """

    name: str
    cameras: Mapping[str, Path]
    table: Path | None
    tables: tuple[str, ...] = ()
    begins: str = ""
    rows: tuple[int, int, int] | None = None


class Columns(NamedTuple):
    """What the columns of the tables are.

    Attributes:
        actions: names of the columns of actions.
        states: the states, and the names of the columns of each.
        time: the column of times in seconds; None if there is none.
        frame: the column of numbers of frames; None if there is none.
        episode: the column that names the episode, in a table for all.
        texts: names of the columns that hold text, which are kept as facts.
        known: names of all columns of the table.
    """

    actions: tuple[str, ...]
    states: Mapping[str, tuple[str, ...]]
    time: str | None
    frame: str | None
    episode: str | None
    texts: tuple[str, ...] = ()
    known: tuple[str, ...] = ()


class Videos(Format):
    """Videos or folders of pictures, with actions in tables beside them; read only."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether it holds videos or folders of pictures, and tables."""
        if not path.is_dir():
            return False
        places = find_places(path)
        return bool(places) and bool(files_in(path, READERS) or any(p.table for p in places))

    @guarded
    def read(
        self,
        root: Path,
        *,
        actions: str | None = None,
        columns: str | None = None,
        states: str | None = None,
        time: str | None = None,
        rate: float | None = None,
        from_first_row: bool = False,
        unlabelled: bool = False,
        follow_links: bool = False,
    ) -> RecordedDataset:
        """Import a folder of videos, one episode each, with actions in a table beside each.

        Each video in ROOT (mp4, mov, mkv, webm, avi, gif), or folder of pictures, has a table of
        the same name: csv, tsv, npy, npz, json, jsonl or parquet. Or ROOT has a folder per episode,
        with a video or folder of pictures per camera and one table. One table in ROOT may cover all
        videos, with a column such as episode or video. Pictures named like ep_0_step_0.png are an
        episode per first number. Rows belong to frames by a column of times (time, timestamp, t;
        time_ms and the like are in that unit), by a column frame, or by their number.

        Args:
            root: the folder.
            actions: Name of the table for all episodes, or of the one in each episode's folder.
            columns: Names of the columns of actions, e.g. x,y; by default those called action…, or
                all that hold numbers.
            states: Names of the columns to keep as states, or what names such as block_x, block_y
                begin with (block), which become one; none by default.
            time: Name of the column of times.
            rate: Frames per second of folders of pictures.
            from_first_row: Whether the first row was taken with the first frame, if the clocks of
                table and video differ.
            unlabelled: Whether no actions were recorded; `acwm data label` reads them from the
                videos, given others with actions.
            follow_links: Whether links may lead out of the folder.
        """
        root = Path(root)
        places = find_places(root, actions)
        if not places:
            loose = ": put those of each recording into a folder" * bool(_pictures(root))
            raise DataError(f"{root} holds no video and no folder of pictures{loose}")
        if unlabelled:
            return _without_actions(root, places, rate, follow_links)
        table = _shared(root, places, actions)
        tables = [table] if table else [place.table for place in places if place.table]
        if not tables:
            endings = ", ".join(ending[1:] for ending in READERS)
            raise DataError(
                f"{root} has no table of actions beside {places[0].name}: {endings}; if none were "
                "recorded, give --unlabelled"
            )
        path = first_sound(tables, read_table)
        acting, kept = (tuple(map(composed, words(names))) for names in (columns, states))
        chosen = _columns(path, acting, kept, time and composed(time), shared=table is not None)
        options = {"actions": actions, "columns": columns, "states": states, "time": time}
        options |= {"rate": rate, "from_first_row": from_first_row, "follow_links": follow_links}
        return RecordedDataset(
            name=word(root),
            splits=VideoFolder(
                dict(enumerate(places)), len(places), table, chosen, rate, from_first_row
            ),
            facts={"kind": "videos", "name": root.resolve().name, **_facts(places, table)},
            options=options,
            actions=ActionFacts(chosen.actions),
            notes=_notes(root, places, path, chosen),
            summary=f"Videos of {root.resolve().name}",
        )

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """Three short videos of a moving square, with a table of times and actions each."""
        write_example_videos(folder)
        return {"root": folder}


@dataclass(frozen=True)
class VideoFolder:
    """The episodes of a folder, opened on request.

    Attributes:
        places: where each episode lies.
        count: number of episodes in the folder.
        table: the table for all, if there is one.
        columns: what the columns of tables are.
        rate: frames per second of pictures.
        from_first_row: whether the first row was taken with the first frame.
    """

    places: Mapping[int, VideoEpisode]
    count: int
    table: Path | None
    columns: Columns
    rate: float | None
    from_first_row: bool

    def __len__(self) -> int:
        """The number of episodes."""
        return self.count

    def part(self, indices: Sequence[int]) -> VideoFolder:
        """The same, with the places of some episodes."""
        return replace(self, places={index: self.places[index] for index in indices})

    def __getitem__(self, index: int) -> TimedRecording:
        """Open one episode."""
        place = self.places[index]
        with damage_of(self.table or place.table or Path(place.name)):
            return self._opened(place, index)

    def _opened(self, place: VideoEpisode, index: int) -> TimedRecording:
        rows, path = self._rows(place, index)
        times = None
        if self.columns.time:
            times = seconds(rows, self.columns.time, path)
        cameras = {n: self._frames(p, times, place.begins) for n, p in place.cameras.items()}
        first = next(iter(cameras.values()))
        samples = self._samples(rows, path, self._same_clock(times, first.times, path))
        rate = None
        if isinstance(first, VideoFrames):
            rate = video_index(first.path).rate
        parts = self.columns.states.items()
        states = {name: samples(numbers(rows, names, path)) for name, names in parts}
        actions = samples(numbers(rows, self.columns.actions, path))
        others = [name for name in rows if name not in self.columns.known]
        facts = text_facts(
            {n: rows[n].tolist() for n in (*self.columns.texts, *others) if n in rows}
        )
        left = ", ".join(name for name in others if name not in facts)
        notes = (f"columns that the first table lacks were left out: {left}",) if left else ()
        return TimedRecording(place.name, cameras, actions, states, rate, facts=facts, notes=notes)

    def _rows(self, place: VideoEpisode, index: int) -> tuple[Table, Path]:
        """The rows of an episode, and the file that they are in."""
        path = self.table or place.table
        if self.table is None and place.tables:
            several = ", ".join(place.tables)
            raise DataError(
                f"{place.name} has several tables ({several}): keep one, or name it with --actions"
            )
        if path is None:
            raise DataError(f"there is no table of actions beside {place.name}")
        rows = _read_once(path, file_stamp(path)) if self.table else read_table(path)
        column = self.columns.episode if self.table else episode_column(rows)
        if self.table and column:
            rows = _rows_of(rows, column, index, place, self.count, path)
        elif column and (known := len({*rows[column].tolist()})) > 1:
            raise DataError(
                f"the column {column} of {path} numbers {known} episodes, but {place.name} "
                "is one: record a video for each"
            )
        elif self.table and place.rows:
            start, stop, count = place.rows
            if (own := len(next(iter(rows.values())))) != count:
                raise DataError(f"{path} has {own} rows, but its episodes have {count} pictures")
            rows = {name: values[start:stop] for name, values in rows.items()}
        self._check_one(rows, place, path)
        return rows, path

    def _check_one(self, rows: Table, place: VideoEpisode, path: Path) -> None:
        """Refuse rows of several episodes beside the frames of one."""
        numbering = {
            "time" if name == self.columns.time else name: values
            for name, values in rows.items()
            if name == self.columns.time or is_clock(name) or (tells(name) and not self.table)
        }
        if several := bounds_of(numbering, len(next(iter(rows.values()))), str(path)):
            raise DataError(
                f"{path} has {len(several)} episodes, by {', '.join(numbering)}, but {place.name} "
                "is one: record a video for each"
            )

    def _frames(self, source: Path, times: NDArray[np.float64] | None, begins: str) -> Frames:
        """A video, or pictures with the times of `rate` or else of the table's rows."""
        if source.is_file():
            return VideoFrames(source)
        paths = [path for path in _pictures(source) if not begins or begins in dict(keys(path))]
        if self.rate:
            times = regular_times(len(paths), exact(self.rate))
        elif times is None or len(times) != len(paths) or _counts_rows(times):
            raise DataError(f"{source} holds {len(paths)} pictures: give --rate, frames per second")
        stamps = [path.stat() for path in paths]
        stamp = f"{sum(s.st_size for s in stamps)} {max(s.st_mtime_ns for s in stamps)}"
        return ImageFrames(paths, times, stamp=stamp)

    def _same_clock(
        self, times: NDArray[np.float64] | None, frame_times: NDArray[np.float64], path: Path
    ) -> NDArray[np.float64] | None:
        """The times of rows on the clock of the video; None if they count its frames."""
        if times is None or not len(frame_times):
            return times
        counted = _counts_rows(times - times[0] if self.from_first_row else times)
        if counted and len(frame_times) - len(times) in (0, 1):
            return None
        offset = frame_times[0] - times[0] if self.from_first_row else 0.0
        rows: NDArray[np.float64] = times + offset
        span, duration = rows[-1] - rows[0], frame_times[-1] - frame_times[0]
        if rows[0] <= frame_times[-1] and span > (2 if counted else 10) * duration > 0:
            raise DataError(
                f"the times of {path} span {span:,.4g} s, and the video {duration:.4g} s: in "
                "milliseconds or nanoseconds, call their column time_ms or time_ns; if they number "
                "frames, frame"
            )
        if rows[0] > frame_times[-1] or rows[-1] < frame_times[0]:
            raise DataError(
                f"the times of {path} ({rows[0]:g} to {rows[-1]:g} s) are not those of the video "
                f"({frame_times[0]:g} to {frame_times[-1]:g} s): give --from-first-row if the "
                "first row was taken with the first frame"
            )
        return rows

    def _samples(
        self, rows: Table, path: Path, times: NDArray[np.float64] | None
    ) -> functools.partial[Samples]:
        """Makes the samples of some values in rows of the table."""
        frames = None
        if times is None and self.columns.frame:
            frames = number_column(rows, self.columns.frame, path).astype(np.int64)
        return functools.partial(Samples, times=times, frames=frames)


def _counts_rows(times: NDArray[np.float64]) -> bool:
    """Whether what is called times numbers the rows, from 0 or 1."""
    return len(times) > 2 and times[0] in (0, 1) and bool((np.diff(times) == 1).all())


def find_places(root: Path, actions: str | None = None) -> list[VideoEpisode]:
    """The episodes in a folder, in natural order: 2 comes before 10.

    Raises:
        DataError: several tables have the name of a video, but for the case of letters.
    """
    episodes: list[VideoEpisode] = []
    beside = _Tables(files_in(root, READERS))
    for path in files_in(root, [""]):
        if path.name.startswith("_"):
            continue
        if path.suffix.lower() in VIDEOS and path.is_file():
            episodes.append(_tabled(path.stem, {"video": path}, beside.of(path.stem)))
        elif path.is_dir():
            episodes += _folder(path, actions, beside)
    return episodes or _grouped(root, None)


class _Tables:
    """Tables by the names of their files, whose case and way of composing letters may differ."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths: dict[str, list[Path]] = {}
        for path in paths:
            self._paths.setdefault(folded(path.stem), []).append(path)

    def of(self, stem: str) -> list[Path]:
        """The tables of the episode with this name, which has one at best."""
        same = self._paths.get(folded(stem), [])
        same = [path for path in same if composed(path.stem) == composed(stem)] or same
        if len({path.stem for path in same}) > 1:
            names = " and ".join(path.name for path in same)
            if len({composed(path.name) for path in same}) == 1:
                names += ", which differ in how their accents are stored,"
            raise DataError(f"{names} could both be the table of {stem}: rename one")
        endings = [*READERS]
        return sorted(same, key=lambda path: endings.index(path.suffix.lower()))


def _folder(folder: Path, actions: str | None, beside: _Tables) -> list[VideoEpisode]:
    """The episode that a folder is: pictures, or a video or folder of pictures per camera."""
    inner = [
        path
        for path in files_in(folder, READERS)
        if actions is None or folded(path.name) == folded(actions)
    ]
    tables = inner or beside.of(folder.name)
    if _pictures(folder):
        several = _grouped(folder, tables[0] if len(tables) == 1 else None)
        return several or [_tabled(folder.name, {"video": folder}, tables)]
    cameras = {
        path.stem if path.is_file() else path.name: path
        for path in files_in(folder, [""])
        if path.suffix.lower() in VIDEOS or (path.is_dir() and _pictures(path))
    }
    return [_tabled(folder.name, cameras, tables)] if cameras else []


def _tabled(name: str, cameras: Mapping[str, Path], tables: Sequence[Path]) -> VideoEpisode:
    """An episode with its table, or with several of which none is chosen."""
    if len(tables) == 1:
        return VideoEpisode(name, cameras, tables[0])
    return VideoEpisode(name, cameras, None, tuple(path.name for path in tables))


def _grouped(folder: Path, table: Path | None) -> list[VideoEpisode]:
    """The episodes of a folder whose pictures are numbered in each, as ``ep_0_step_0.png``.

    They are numbered anew; or on, if the name says what its first number counts, as ``ep0_000``.
    The number of the episode may come last, as in ``frame_0_ep_0.png``.

    Raises:
        DataError: they are the pictures of several cameras, or of episodes that cannot be told.
    """
    paths = [path for path in _pictures(folder) if numbered(path)]
    groups = told_apart(folder, paths) if paths else {}
    if not groups:
        return []
    if stray := [path.name for path in _pictures(folder) if path not in paths]:
        raise DataError(f"{folder} has pictures of several recordings, and {stray[0]}: remove it")
    ends = np.cumsum([len(numbers) for numbers in groups.values()]).tolist()
    starts = [0, *ends[:-1]]
    return [
        VideoEpisode(title(key), {"video": folder}, table, (), key, (start, stop, ends[-1]))
        for key, start, stop in zip(groups, starts, ends, strict=True)
    ]


def _pictures(folder: Path) -> list[Path]:
    return files_in(folder, PICTURES)


def _shared(root: Path, places: Sequence[VideoEpisode], actions: str | None) -> Path | None:
    """The table for all episodes, if there is one."""
    tables = files_in(root, READERS)
    named = [path for path in tables if actions and folded(path.name) == folded(actions)]
    if named:
        return named[0]
    own = {place.table for place in places}
    if len(places) > 1 and len(own) == 1 and None not in own:
        return own.pop()  # of a folder with the pictures of all
    if any(place.table or place.tables for place in places):
        return None
    if len(tables) > 1:
        names = ", ".join(path.name for path in tables)
        raise DataError(f"{root} has several tables ({names}): give --actions NAME")
    return tables[0] if tables else None


@functools.lru_cache(maxsize=2)
def _read_once(path: Path, _: str) -> Table:
    return read_table(path)


def _rows_of(
    table: Table, column: str, index: int, place: VideoEpisode, count: int, path: Path
) -> Table:
    """The rows of one episode, named by its video or by its place in natural order."""
    values = table[column]
    if values.dtype.kind in "iuf":
        known = np.unique(values)
        if not np.array_equal(known, np.arange(count)):
            raise DataError(
                f"the column {column} of {path} numbers {len(known)} episodes from {known[0]:g} to "
                f"{known[-1]:g}, but there are {count} videos: number them from 0, or use "
                "names"
            )
        chosen = values == index
    else:
        files = {place.name, *(source.name for source in place.cameras.values())}
        names = [composed(str(value)) for value in values]
        chosen = np.array([name in {*map(composed, files)} for name in names])
        if not chosen.any():
            chosen = np.array([folded(name) in {*map(folded, files)} for name in names])
    if not chosen.any():
        raise DataError(f"{path} has no row of {place.name} in the column {column}")
    return {name: rows[chosen] for name, rows in table.items()}


def _columns(
    path: Path,
    actions: tuple[str, ...],
    states: tuple[str, ...],
    time: str | None,
    *,
    shared: bool,
) -> Columns:
    """What the columns of a table are; the others have the same."""
    table = read_table(path)
    kept = {name: _entries(table, name) or (name,) for name in states}
    used = (*actions, *itertools.chain(*kept.values()), *words(time))
    for name in used:
        if name not in table:
            raise DataError(f"{path} has no column {name!r}{suggest(name, table)}")
    free = [name for name in action_columns(table) if name not in used]
    numeric = [name for name in free if holds_numbers(table[name])]
    actions = actions or tuple([name for name in numeric if is_action(name)] or numeric)
    if not actions:
        raise DataError(f"{path} has no column of actions, only {', '.join(table)}")
    episode = episode_column(table) if shared else None
    time = time or special_column(table, TIMES)
    texts = tuple(name for name in free if name not in numeric)
    return Columns(actions, kept, time, special_column(table, FRAMES), episode, texts, (*table,))


def _entries(table: Table, name: str) -> tuple[str, ...]:
    """The columns of a vector, e.g. of `block`: `block_x` and `block_y`, or `block.0` and more."""
    entry = re.compile(rf"{re.escape(name)}[._](\d+|[wxyz])")
    return () if name in table else tuple(column for column in table if entry.fullmatch(column))


class UnlabelledVideos(VideoFolder):
    """The same, of which no actions are known: they are zero, and the card says so."""

    def _opened(self, place: VideoEpisode, index: int) -> TimedRecording:
        cameras = {n: self._frames(p, None, place.begins) for n, p in place.cameras.items()}
        first = next(iter(cameras.values()))
        rate = video_index(first.path).rate if isinstance(first, VideoFrames) else None
        count = len(first.times)
        return TimedRecording(place.name, cameras, Samples(np.zeros((count, 1))), rate=rate)


def _without_actions(
    root: Path, places: Sequence[VideoEpisode], rate: float | None, follow_links: bool
) -> RecordedDataset:
    """Videos of which no actions were recorded; nothing can be trained on them as they are."""
    columns = Columns((), {}, None, None, None)
    advice = "no actions were recorded: run `acwm data label` with episodes that have some"
    return RecordedDataset(
        name=word(root),
        splits=UnlabelledVideos(dict(enumerate(places)), len(places), None, columns, rate, False),
        facts={"kind": "videos", "name": root.resolve().name, **_facts(places, None)}
        | {"unusable": advice},
        options={"rate": rate, "unlabelled": True, "follow_links": follow_links},
        actions=ActionFacts(("unknown",), bounds=((-1.0,), (1.0,))),
        notes=(f"{advice[0].upper()}{advice[1:]}.",),
        summary=f"Videos of {root.resolve().name}",
    )


def _facts(places: Sequence[VideoEpisode], table: Path | None) -> dict[str, Any]:
    """What identifies the folder without reading all of it."""
    sources = [path for place in places for path in place.cameras.values()]
    sources += [path for path in (table, *(place.table for place in places)) if path]
    files = [path for path in sources if path.is_file()]
    return {"episodes": len(places), "bytes": sum(path.stat().st_size for path in files)}


def _notes(
    root: Path, places: Sequence[VideoEpisode], path: Path, chosen: Columns
) -> tuple[str, ...]:
    known = {*chosen.actions, *itertools.chain(*chosen.states.values()), *chosen.texts}
    known |= {chosen.time, chosen.frame, chosen.episode}
    left = [name for name in read_table(path) if name not in known]
    notes = [f"Actions are the columns {', '.join(chosen.actions)}."]
    if left:
        notes.append(f"Columns that are neither actions nor states: {', '.join(left)}.")
    notes += text_note(chosen.texts)
    if places[0].begins:
        notes.append(f"Pictures are {len(places)} episodes, by the numbers in their names.")
    if chosen.time is None and chosen.frame is None:
        notes.append(
            "Rows belong to frames by their number, because the tables have no column of times."
        )
    used = {place.table for place in places} | {path}
    if lone := [table.name for table in files_in(root, READERS) if table not in used]:
        notes.append(f"Tables without a video: {', '.join(lone[:5])}{' …' * (len(lone) > 5)}.")
    if chosen.episode and (names := read_table(path)[chosen.episode]).dtype.kind not in "iuf":
        films = {n for p in places for n in (p.name, *(video.name for video in p.cameras.values()))}
        known = {folded(film) for film in films}
        if lone := sorted({n for n in map(str, names.tolist()) if folded(n) not in known}):
            notes.append(f"Rows without a video: {', '.join(lone[:5])}{' …' * (len(lone) > 5)}.")
    if unread := _unread(root, places, used):
        notes.append(
            f"Files that were not read: {', '.join(unread[:5])}{' …' * (len(unread) > 5)}."
        )
    return tuple(notes)


def _unread(root: Path, places: Sequence[VideoEpisode], tables: set[Path | None]) -> list[str]:
    """Names of files and folders beside the recordings that are none."""
    used = {path for place in places for path in place.cameras.values()} | tables
    used |= {path.parent for path in used if path and path.parent != root}
    return [
        path.name
        for path in files_in(root, [""])
        if path not in used
        and not path.name.startswith("_")
        and path.suffix.lower() not in READERS
        and not (root in used and path.suffix.lower() in PICTURES)
    ]
