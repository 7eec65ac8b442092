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
from acwm_core.errors import DataError
from acwm_formats.example import exported_example
from acwm_formats.format import Export, Format
from acwm_formats.frames import ImageFrames, VideoFrames, file_stamp, video_index
from acwm_formats.lerobot_export import Writer
from acwm_formats.lerobot_layout import (
    ACTION,
    INFO,
    Place,
    arrow,
    as_one_sentence,
    read_card,
    read_columns,
    read_info,
    read_places,
)
from acwm_formats.names import is_action, text_note, word
from acwm_formats.timeline import ActionFacts, Frames, RecordedDataset, Samples, TimedRecording

FRAME, REWARD = "frame_index", "next.reward"

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

    def read(self, root: Path) -> RecordedDataset:
        """Import the LeRobot dataset in the folder ROOT, of version 3.0, 2.1 or 2.0.

        Imports the frames of one or several cameras, the actions and the observed numbers; tasks
        and rewards are kept as facts of the episodes. The bounds of actions are the range of the
        training episodes, since the format has none; if acwm wrote the dataset, they come from its
        card.

        Args:
            root: the dataset's folder, with `meta`, `data` and `videos` in it.
        """
        root = Path(root)
        with as_one_sentence(root):
            info = read_info(root)
            features = cast(dict[str, dict[str, Any]], info["features"])
            _check_features(features)
            places = read_places(root)
            if not places:
                raise DataError(f"{root} holds no episodes")
            ours = read_card(root)
            name = ours.name if ours else ""
            return RecordedDataset(
                name or word(root),
                LeRobotRecordings(root),
                {"kind": "lerobot", "name": root.resolve().name, **_facts(root, places)},
                fps=_rate(info, ours),
                tests=_tests(info, len(places)),
                options={},
                actions=_action(features, ours),
                state=tuple(_state(features)),
                notes=() if ours else _notes(features, places),
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

    def __len__(self) -> int:
        """The number of episodes."""
        return len(_index(self.root).places)

    def __getitem__(self, index: int) -> TimedRecording:
        """Open an episode, without decoding its frames."""
        with as_one_sentence(self.root):
            return self._opened(index)

    def _opened(self, index: int) -> TimedRecording:
        whole = _index(self.root)
        place = whole.places[index]
        states = [field.name for field in _state(whole.features)]
        rewards = [REWARD] if REWARD in whole.features else []
        names = [FRAME, ACTION, *states, *rewards]
        table = read_columns(place.data, names, place.episode)
        columns = {name: _numbers(table, name) for name in names}
        numbers = columns[FRAME][:, 0].astype(np.int64)
        cameras = _Cameras(tuple(_cameras(whole.features)), index, self.root, numbers / whole.fps)
        facts: dict[str, Any] = {"episode": place.episode, "tasks": list(place.tasks)}
        if rewards:
            facts["rewards"] = columns[REWARD].reshape(-1).tolist()
        return TimedRecording(
            f"episode {place.episode}",
            cameras,
            Samples(columns[ACTION], frames=numbers),
            {name: Samples(columns[name], frames=numbers) for name in states},
            rate=Fraction(whole.fps).limit_denominator(100_000),
            length=place.length,
            facts=facts,
        )


@dataclass(frozen=True)
class _Cameras(Mapping[str, Frames]):
    """The frames of each camera; a video is looked at, and fetched, only if it is asked for."""

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
            with as_one_sentence(self.root):
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
class _Index:
    """Where all episodes lie, read once per worker."""

    features: dict[str, dict[str, Any]]
    fps: float
    places: list[Place]

    @functools.cached_property
    def _by_file(self) -> dict[tuple[str, Path], list[Place]]:
        """The episodes of each video, in their order there."""
        found: dict[tuple[str, Path], list[Place]] = {}
        for place in self.places:
            for camera, (path, _) in place.videos.items():
                found.setdefault((camera, path), []).append(place)
        for (camera, _), inside in found.items():
            inside.sort(key=lambda place: place.videos[camera][1])
        return found

    def video(self, index: int, camera: str) -> VideoFrames:
        """The frames of an episode in a video of one or many episodes.

        They are counted if the file has as many as its episodes together, else told by time.
        """
        path, start = self.places[index].videos[camera]
        inside = self._by_file[camera, path]
        if len(inside) == 1 and start == 0:
            return VideoFrames(path)
        times = video_index(path).times
        at = [place.episode for place in inside].index(self.places[index].episode)
        before = sum(place.length for place in inside[:at])
        if sum(place.length for place in inside) == len(times):
            stop = before + self.places[index].length
            return VideoFrames(path, before, stop, float(times[before]))
        edges = [*(place.videos[camera][1] for place in inside[at : at + 2]), np.inf][:2]
        first, stop = np.searchsorted(times, np.array(edges) - 0.5 / self.fps).tolist()
        return VideoFrames(path, first, stop, start)


@functools.lru_cache(maxsize=2)
def _index_of(root: Path, _: str) -> _Index:
    info = read_info(root)
    return _Index(info["features"], info["fps"], read_places(root))


def _index(root: Path) -> _Index:
    meta = [root / INFO, *(root / "meta").glob("episodes*"), *(root / "meta").glob("episodes/*/*")]
    return _index_of(root, " ".join(map(file_stamp, meta)))


@dataclass(frozen=True)
class _RowImages:
    """The images in the rows of an episode."""

    place: Place
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


def _check_features(features: Mapping[str, Mapping[str, Any]]) -> None:
    if not _cameras(features):
        raise DataError("the dataset has no camera, and a world model predicts video")
    if ACTION not in features:
        raise DataError("the dataset has no actions, and a world model is conditioned on them")


def _action(features: Mapping[str, Mapping[str, Any]], ours: EnvironmentCard | None) -> ActionFacts:
    if ours:
        spec = ours.action
        return ActionFacts(spec.names, spec.units, spec.kind, (spec.low, spec.high))
    names, shape = _names(features[ACTION]), features[ACTION].get("shape")
    fits = isinstance(shape, list) and [len(names)] == shape
    return ActionFacts(tuple(names) if fits else ())


def _notes(features: Mapping[str, Any], places: Sequence[Place]) -> tuple[str, ...]:
    """What people should know about how the dataset was read."""
    notes = ["The units of actions are not known."]
    if left := [name for name in features if is_action(name) and name != ACTION]:
        notes.append(f"Features that were left out: {', '.join(left)}.")
    return (*notes, *(text_note(["tasks"]) if any(place.tasks for place in places) else []))


def _state(features: Mapping[str, Mapping[str, Any]]) -> list[StateField]:
    """The state fields: all observed numbers."""
    fields: list[StateField] = []
    for name, feature in features.items():
        numeric = re.fullmatch(r"(float|u?int)\d+|bool", str(feature.get("dtype")))
        if name.startswith("observation.") and numeric:
            shape = tuple(int(n) for n in feature.get("shape", ())) or (1,)
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


def _tests(info: Mapping[str, Any], episodes: int) -> dict[Split, Sequence[int]]:
    """The test episodes that the dataset names."""
    tests: dict[Split, list[int]] = {}
    for name, text in cast(dict[str, Any], info.get("splits") or {}).items():
        found = re.fullmatch(r"(\d+):(\d+)", str(text))
        if found and name in TESTS:
            tests.setdefault(TESTS[name], []).extend(
                range(int(found[1]), min(int(found[2]), episodes))
            )
    return {split: numbers for split, numbers in tests.items() if numbers}


def _facts(root: Path, places: Sequence[Place]) -> dict[str, Any]:
    """Facts that identify this dataset without reading all of it."""
    digest = hashlib.sha256((root / INFO).read_bytes())
    starts = [[start for _, start in place.videos.values()] for place in places]
    lengths = [(place.episode, place.length) for place in places]
    digest.update(repr((lengths, starts)).encode())
    return {"sha256_of_meta": digest.hexdigest()}
