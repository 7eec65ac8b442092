"""The format of LeRobot: the frames of cameras, actions and observed numbers."""

from __future__ import annotations

import functools
import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import EnvironmentCard, StateField
from acwm_core.env.episode import Split
from acwm_core.errors import DataError, suggest
from acwm_formats.example import exported_example
from acwm_formats.format import Export, Format
from acwm_formats.frames import ImageFrames, VideoFrames, file_stamp, video_index
from acwm_formats.lerobot_export import Writer
from acwm_formats.lerobot_layout import (
    ACTION,
    COLUMNS,
    INFO,
    EpisodeFiles,
    arrow,
    read_card,
    read_columns,
    read_info,
    read_places,
)
from acwm_formats.names import is_action, word, words
from acwm_formats.sources import damage_of, guarded
from acwm_formats.texts import text_facts, text_note
from acwm_formats.timeline import ActionFacts, Frames, RecordedDataset, Samples, TimedRecording

FRAME = "frame_index"

FACTS = {"next.reward": "rewards", "next.success": "successes"}
"""Features that become facts of the episodes, and what these are called."""

TESTS: dict[str, Split] = {
    "ind_test": "ind_test",
    "test": "ind_test",
    "ood_test": "ood_test",
}
"""Splits of ``meta/info.json`` that are kept as test splits; all others become training data."""


class LeRobot(Format):
    """LeRobot datasets: 3.0 and 2.x are read, 3.0 is written."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether there is a ``meta/info.json``."""
        return (path / INFO).is_file()

    @guarded
    def read(
        self, root: Path, *, actions: str | None = None, follow_links: bool = False
    ) -> RecordedDataset:
        """Import the LeRobot dataset in the folder ROOT, of version 3.0, 2.1 or 2.0.

        Imports the frames of one or several cameras, the actions and the observed numbers; tasks,
        rewards and successes are kept as facts of the episodes. The bounds of actions are the range
        of the training episodes, since the format has none; if acwm wrote the dataset, they come
        from its card.

        Args:
            root: the dataset's folder, with `meta`, `data` and `videos` in it.
            actions: Features that are the actions, joined in this order, e.g. arm,gripper; by
                default action, or the only one that is called so.
            follow_links: Whether links may lead out of the folder.
        """
        root = Path(root)
        info = read_info(root)
        features = cast(dict[str, dict[str, Any]], info["features"])
        if not _cameras(features):
            raise DataError("the dataset has no camera, but a world model predicts video")
        acting = _action_names(features, words(actions))
        places = read_places(root)
        if not places:
            raise DataError(f"{root} holds no episodes")
        ours = read_card(root)
        name = ours.name if ours else ""
        observed = [field for field in _state(features) if field.name not in acting]
        outcomes = [name for name in FACTS if name in features and _is_numeric(features[name])]
        empty = _empty(places[0], [*(field.name for field in observed), *outcomes])
        state = tuple(field for field in observed if field.name not in empty)
        unused = _unused(features, (*acting, *(field.name for field in observed), *outcomes))
        texts = [*["tasks"] * any(p.tasks for p in places), *places[0].texts, *_texts(features)]
        return RecordedDataset(
            name or word(root),
            LeRobotRecordings(
                *(root, acting, tuple(field.name for field in state)),
                tuple(name for name in outcomes if name not in empty),
            ),
            {"kind": "lerobot", "name": root.resolve().name, **_facts(root, places)},
            fps=_rate(info, ours),
            tests=_tests(info, places),
            options={"actions": actions, "follow_links": follow_links},
            actions=_action(features, acting, ours),
            state=state,
            notes=(*_notes(acting, unused, empty, texts),) if not ours else (),
            summary=ours.summary if ours else f"{info.get('robot_type') or 'a robot'}",
        )

    def write(self, export: Export) -> None:
        """Write a LeRobot dataset of version 3.0 with one camera.

        Video is visually lossless, not bit-exact. The format cannot store masks, contacts and
        factors. State fields of up to 64 numbers are joined to `observation.state`. Larger ones
        become separate features, with statistics of the whole dataset but not of each episode.
        `meta/acwm.json` keeps the environment's card, so that an import knows units and bounds.
        """
        writer = Writer(export.folder, export.card.environment)
        splits: dict[str, str] = {}
        for split in export.splits:
            first = len(writer.episodes)
            for episode in export.episodes(split):
                writer.add(episode)
            splits[split] = f"{first}:{len(writer.episodes)}"
        writer.close(splits)

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """An example dataset that `write` made."""
        return {"root": exported_example(folder, cls())}


def _rate(info: Mapping[str, Any], ours: EnvironmentCard | None) -> float:
    """The rate; that of our own card is exact."""
    return ours.fps if ours and abs(ours.fps / info["fps"] - 1) < 1e-6 else info["fps"]


@dataclass(frozen=True)
class LeRobotRecordings:
    """The episodes of a LeRobot dataset, opened on request."""

    root: Path
    actions: tuple[str, ...]
    states: tuple[str, ...]
    outcomes: tuple[str, ...]

    def __len__(self) -> int:
        """The number of episodes."""
        return len(_index(self.root).places)

    def __getitem__(self, index: int) -> TimedRecording:
        """Open an episode, without decoding its frames."""
        with damage_of(self.root):
            return self._opened(index)

    def _opened(self, index: int) -> TimedRecording:
        whole = _index(self.root)
        place = whole.places[index]
        names = [FRAME, *self.actions, *self.states, *self.outcomes]
        texts = _texts(whole.features)
        table = read_columns(place.data, [*names, *texts], place.episode)
        columns = {name: _numbers(table, name) for name in names}
        actions = np.concatenate([columns[name] for name in self.actions], axis=1)
        numbers = columns[FRAME][:, 0].astype(np.int64)
        cameras = _Cameras(tuple(_cameras(whole.features)), index, self.root, numbers / whole.fps)
        facts: dict[str, Any] = {"episode": place.episode, "tasks": list(place.tasks)}
        facts |= {**place.texts, **text_facts({n: table.column(n).to_pylist() for n in texts})}
        facts |= {FACTS[name]: columns[name].reshape(-1).tolist() for name in self.outcomes}
        return TimedRecording(
            f"episode {place.episode}",
            cameras,
            Samples(actions, frames=numbers),
            {name: Samples(columns[name], frames=numbers) for name in self.states},
            rate=Fraction(whole.fps).limit_denominator(100_000),
            length=place.length,
            facts=facts,
        )


@dataclass(frozen=True)
class _Cameras(Mapping[str, Frames]):
    """The frames of each camera; a video is fetched and opened only if it is needed."""

    names: tuple[str, ...]
    index: int
    root: Path
    times: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __contains__(self, name: object) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> Frames:
        if name not in self.names:
            raise KeyError(name)
        if name not in self._looked_at:
            with damage_of(self.root):
                self._looked_at[name] = self._frames(name)
        return self._looked_at[name]

    @functools.cached_property
    def _looked_at(self) -> dict[str, Frames]:
        return {}

    def _frames(self, name: str) -> Frames:
        whole = _index(self.root)
        place = whole.places[self.index]
        if name in place.videos:
            return whole.video(self.index, name)
        stamp = f"{place.episode} {file_stamp(place.data)}"
        return ImageFrames(_RowImages(place, name), self.times, stamp=stamp)


@dataclass(frozen=True)
class _EpisodeIndex:
    """Where all episodes lie, read once per worker."""

    features: dict[str, dict[str, Any]]
    fps: float
    places: list[EpisodeFiles]

    @functools.cached_property
    def _by_file(self) -> dict[tuple[str, Path], list[EpisodeFiles]]:
        """The episodes of each video, in their order there."""
        by_file: dict[tuple[str, Path], list[EpisodeFiles]] = {}
        for place in self.places:
            for camera, span in place.videos.items():
                by_file.setdefault((camera, span.path), []).append(place)
        for (camera, _), inside in by_file.items():
            inside.sort(key=lambda place: place.videos[camera].start)
        return by_file

    def video(self, index: int, camera: str) -> VideoFrames:
        """The frames of an episode in a video of one or many episodes.

        They are counted if the file has as many as its episodes together, else told by time: it may
        have those of episodes that were removed.
        """
        path, start, end = self.places[index].videos[camera]
        inside = self._by_file[camera, path]
        alone = len(inside) == 1 and start == 0
        if alone and end is None:
            return VideoFrames(path)
        times = video_index(path).times
        half = 0.5 / self.fps
        if alone and times[-1] < cast(float, end) - half:
            return VideoFrames(path)
        at = [place.episode for place in inside].index(self.places[index].episode)
        before = sum(place.length for place in inside[:at])
        if sum(place.length for place in inside) == len(times):
            stop = before + self.places[index].length
            return VideoFrames(path, before, stop, float(times[before]))
        ends = [place.videos[camera].start for place in inside[at + 1 : at + 2]]
        edges = start, min([np.inf if end is None else end, *ends])
        first, stop = np.searchsorted(times, np.array(edges) - half).tolist()
        return VideoFrames(path, first, stop, start)


@functools.lru_cache(maxsize=2)
def _index_of(root: Path, _: str) -> _EpisodeIndex:
    info = read_info(root)
    return _EpisodeIndex(info["features"], info["fps"], read_places(root))


def _index(root: Path) -> _EpisodeIndex:
    meta = [root / INFO, *(root / "meta").glob("episodes*"), *(root / "meta").glob("episodes/*/*")]
    return _index_of(root, " ".join(map(file_stamp, meta)))


@dataclass(frozen=True)
class _RowImages:
    """The images in the rows of an episode."""

    place: EpisodeFiles
    camera: str

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, index: int) -> bytes:
        image = self._images[index]
        if not isinstance(image, dict) or not isinstance(image.get("bytes"), bytes):
            raise DataError(f"{self.place.data} has no image in row {index} of {self.camera}")
        return image["bytes"]

    @functools.cached_property
    def _images(self) -> list[Any]:
        table = read_columns(self.place.data, [self.camera], self.place.episode)
        return table.column(self.camera).to_pylist()


def _numbers(table: Any, name: str) -> NDArray[Any]:
    """A column as an array ``[T, …]``."""
    column, types = table.column(name).combine_chunks(), arrow.types
    if column.null_count:
        row = column.is_null().index(True).as_py()
        raise DataError(f"{name} is null in row {row} (counted from 0)")
    if types.is_list(column.type) and column.flatten().null_count:
        row = next(place for place, entries in enumerate(column.to_pylist()) if None in entries)
        raise DataError(f"{name} has an entry that is null in row {row} (counted from 0)")
    try:
        if types.is_list(column.type) and not types.is_nested(column.type.value_type):
            (length,) = set(column.value_lengths().to_pylist())
            flat = column.flatten().to_numpy(zero_copy_only=False)  # fast, for long recordings
            values = flat.reshape(len(column), length)
        else:
            values = np.array(column.to_pylist())
    except ValueError as error:
        raise DataError(f"{name} has rows of different shapes") from error
    if values.dtype.kind not in "fiub":
        raise DataError(f"{name} holds {values.dtype}, not numbers")
    values = values.astype(np.float32) if values.dtype == np.float64 else values
    return values[:, None] if values.ndim == 1 else values


def _cameras(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return [name for name, f in features.items() if f.get("dtype") in ("video", "image")]


def _action_names(
    features: Mapping[str, Mapping[str, Any]], asked: tuple[str, ...]
) -> tuple[str, ...]:
    """The features that are the actions: those asked for, or what is called so.

    Raises:
        DataError: there is none, or it has to be chosen.
    """
    numeric = [name for name, feature in features.items() if _is_numeric(feature)]
    for name in asked:
        if name not in numeric:
            raise DataError(f"the dataset has no numbers {name!r}{suggest(name, numeric)}")
    called = [name for name in numeric if is_action(name)]
    if asked or ACTION in called:
        return asked or (ACTION,)
    if len(called) == 1:
        return (called[0],)
    if not called:
        others = ", ".join(name for name in numeric if name not in COLUMNS)
        raise DataError(
            "the dataset has no feature action, but a world model needs actions: give "
            f"--actions NAME, one or more of {others}"
        )
    raise DataError(
        f"the dataset has {', '.join(called)}, but none called action: give --actions "
        "with those to join, in order"
    )


def _texts(features: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return [name for name, feature in features.items() if feature.get("dtype") == "string"]


def _is_numeric(feature: Mapping[str, Any]) -> bool:
    return re.fullmatch(r"(float|u?int)\d+|bool", str(feature.get("dtype"))) is not None


def _empty(place: EpisodeFiles, names: Sequence[str]) -> list[str]:
    """The columns that are null throughout an episode; none if it cannot be read."""
    try:
        table = read_columns(place.data, list(names), place.episode)
    except DataError:
        return []  # opening the episode will tell why
    return [name for name in names if len(table) and _is_null(table.column(name))]


def _is_null(column: Any) -> bool:
    """Whether each row is null, or a list of nulls."""
    entries = column.combine_chunks()
    while arrow.types.is_list(entries.type) or arrow.types.is_fixed_size_list(entries.type):
        entries = entries.flatten()
    return entries.null_count == len(entries)


def _unused(features: Mapping[str, Mapping[str, Any]], used: Sequence[str]) -> list[str]:
    known = (*COLUMNS, *used, *_cameras(features), *_texts(features))
    return [name for name in features if name not in known]


def _notes(
    acting: Sequence[str],
    unused: Sequence[str],
    empty: Sequence[str],
    texts: Sequence[str],
) -> Iterator[str]:
    """What people should know about how the dataset was read."""
    if acting != (ACTION,):
        yield f"Actions are {', '.join(acting)}."
    yield "The units of actions are not known."
    if unused:
        yield f"Features that were left out: {', '.join(unused)}."
    if empty:
        yield f"Features that were left out because they are null: {', '.join(empty)}."
    yield from text_note(texts)


def _action(
    features: Mapping[str, Mapping[str, Any]], acting: Sequence[str], ours: EnvironmentCard | None
) -> ActionFacts:
    if ours and tuple(acting) == (ACTION,):
        spec = ours.action
        return ActionFacts(spec.names, spec.units, spec.kind, (spec.low, spec.high))
    names: list[str] = []
    for name in acting:
        own, shape = _names(features[name]), features[name].get("shape")
        fits = isinstance(shape, list) and [len(own)] == shape
        if not fits and len(acting) == 1:
            return ActionFacts()
        size = int(np.prod(cast(list[int], shape))) if isinstance(shape, list) else 1
        names += own if fits else [f"{name}_{place}" for place in range(size)]
    return ActionFacts(tuple(names))


def _state(features: Mapping[str, Mapping[str, Any]]) -> list[StateField]:
    """The state fields: all observed numbers."""
    fields: list[StateField] = []
    for name, feature in features.items():
        if name.startswith("observation.") and _is_numeric(feature):
            shape = tuple(int(n) for n in feature.get("shape") or ()) or (1,)
            about = f"as recorded: {', '.join(_names(feature))}".rstrip(": ")
            fields.append(StateField(name, shape, "", about))
    return fields


def _names(feature: Mapping[str, Any]) -> list[str]:
    """The names of a vector's entries, given by datasets as a list or nested in several ways."""

    def strings(value: Any) -> Iterator[str]:
        if isinstance(value, str):
            yield value
        elif isinstance(value, dict):
            entries = cast(dict[str, Any], value)
            nested = any(isinstance(entry, list | dict) for entry in entries.values())
            yield from strings(list(entries.values() if nested else entries))
        elif isinstance(value, list):
            for entry in cast(list[Any], value):
                yield from strings(entry)

    return list(strings(feature.get("names")))


def _tests(info: Mapping[str, Any], places: Sequence[EpisodeFiles]) -> dict[Split, Sequence[int]]:
    """The test episodes that the dataset names."""
    tests: dict[Split, list[int]] = {}
    for name, text in cast(dict[str, Any], info.get("splits") or {}).items():
        match = re.fullmatch(r"(\d+):(\d+)", str(text))
        if match and name in TESTS:
            first, stop = int(match[1]), int(match[2])
            tests.setdefault(TESTS[name], []).extend(
                index for index, place in enumerate(places) if first <= place.episode < stop
            )
    return {split: numbers for split, numbers in tests.items() if numbers}


def _facts(root: Path, places: Sequence[EpisodeFiles]) -> dict[str, Any]:
    """Facts that identify this dataset without reading all of it."""
    digest = hashlib.sha256((root / INFO).read_bytes())
    starts = [[span.start for span in place.videos.values()] for place in places]
    lengths = [(place.episode, place.length) for place in places]
    digest.update(repr((lengths, starts)).encode())
    return {"sha256_of_meta": digest.hexdigest()}
