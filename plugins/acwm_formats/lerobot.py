"""The format of LeRobot: the frames of one camera, actions and observed numbers."""

from __future__ import annotations

import functools
import hashlib
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from acwm_core.env.environment import ActionSpec, EnvironmentCard, StateField
from acwm_core.env.episode import Split
from acwm_core.errors import DataError, suggest
from acwm_formats.example import exported_example
from acwm_formats.format import Export, Format, import_command
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
from acwm_formats.recordings import RecordedDataset, Recording, recorded_card
from acwm_formats.video import shrunk, target_size, video_facts, video_frames

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

    def read(
        self,
        root: Path,
        *,
        camera: str | None = None,
        test_episodes: int | None = None,
        size: int | tuple[int, int] | None = None,
        environment: str | None = None,
    ) -> RecordedDataset:
        """Import the LeRobot dataset in the folder ROOT, of version 3.0 or 2.x.

        Imports the frames of one camera, the actions and the observed numbers, but not tasks and
        rewards. The bounds of actions are the range of the data, since the format has none; if acwm
        wrote the dataset, they come from its card.

        Args:
            root: the dataset's folder, with `meta`, `data` and `videos` in it.
            camera: Which camera, e.g. observation.images.top; the first by default.
            test_episodes: How many of the last episodes become ind_test; by default the dataset's
                own test splits, or if it has none a tenth, at least two.
            size: Frame size, 64 or HEIGHTxWIDTH; by default that of the videos.
            environment: Name of the environment.
        """
        root, name = Path(root), Path(root).resolve().name
        with as_one_sentence(root):
            info = read_info(root)
            features = cast(dict[str, dict[str, Any]], info["features"])
            camera = _camera(features, camera)
            places = read_places(root, camera)
            if not places:
                raise DataError(f"{root} holds no episodes")
            card = _card(root, info, camera, places, size, environment)
            splits = _splits(info, len(places), test_episodes)
            options = {"camera": camera, "test_episodes": test_episodes}
            options |= {"environment": environment, "size": card.frame_size}
            facts = {"kind": "lerobot", "name": name}
            facts["command"] = import_command("lerobot", name, **options)
            names = tuple(field.name for field in card.state)
            return RecordedDataset(
                card,
                {
                    split: LeRobotRecordings(
                        root, camera, numbers, info["fps"], card.frame_size, names
                    )
                    for split, numbers in splits.items()
                },
                {**facts, **_facts(root, places, splits)},
                notes=_notes(info, features, camera, bounds=read_card(root) is None),
                nominal={s: [places[i].length for i in numbers] for s, numbers in splits.items()},
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
        return {"root": exported_example(folder, cls()), "test_episodes": 1}


def _card(
    root: Path,
    info: Mapping[str, Any],
    camera: str,
    places: Sequence[Place],
    size: int | tuple[int, int] | None,
    environment: str | None,
) -> EnvironmentCard:
    """What the recordings show; action and summary of acwm's own card, if it wrote the dataset."""
    ours = read_card(root)
    robot = f"{info.get('robot_type') or 'a robot'}, seen by {camera}"
    folder = re.sub(r"\W+", "_", root.resolve().name).strip("_").lower()
    return recorded_card(
        environment or (ours.name if ours else folder) or "imported",
        ours.action if ours else _action(info["features"], places),
        frame_size=target_size(_frame_size(places[0], camera), size),
        fps=max(1, round(info["fps"])),
        horizon=max(place.length for place in places),
        state=_state(info["features"]),
        summary=ours.summary if ours else robot,
    )


@dataclass(frozen=True)
class LeRobotRecordings:
    """Some episodes of a LeRobot dataset, read on demand."""

    root: Path
    camera: str
    episodes: Sequence[int]
    fps: float
    size: tuple[int, int]
    states: tuple[str, ...]

    def __len__(self) -> int:
        """The number of episodes."""
        return len(self.episodes)

    def __getitem__(self, index: int) -> Recording:
        """Read an episode; its length is that of the shorter of video and rows."""
        with as_one_sentence(self.root):
            return self._read(index)

    def _read(self, index: int) -> Recording:
        place = _places(self.root, self.camera)[self.episodes[index]]
        names = [ACTION, *self.states]
        table = read_columns(place.data, names, place.episode)
        columns = {name: _numbers(table, name) for name in names}
        frames = min(place.length, *map(len, columns.values()))
        video = shrunk(_frames(place, self.camera, frames, self.fps), self.size)
        return Recording(
            video,
            columns[ACTION][: len(video)],
            {name: columns[name] for name in self.states},
        )


@functools.lru_cache(maxsize=2)
def _places(root: Path, camera: str) -> list[Place]:
    """Read the index once per worker."""
    return read_places(root, camera)


def _frames(place: Place, camera: str, count: int, fps: float) -> Iterator[NDArray[np.uint8]]:
    if place.video is not None:
        yield from video_frames(place.video, start=place.start, count=count, fps=fps)
        return
    column = read_columns(place.data, [camera], place.episode).column(camera)
    for image in column.to_pylist()[:count]:
        try:
            yield np.asarray(Image.open(io.BytesIO(image["bytes"])).convert("RGB"))
        except (OSError, KeyError, TypeError, ValueError, Image.DecompressionBombError) as error:
            raise DataError(f"{place.data} has an image that cannot be read ({error})") from error


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


def _camera(features: Mapping[str, Mapping[str, Any]], wanted: str | None) -> str:
    cameras = [name for name, f in features.items() if f.get("dtype") in ("video", "image")]
    if not cameras:
        raise DataError("the dataset has no camera, and a world model predicts video")
    if wanted is not None and wanted not in cameras:
        raise DataError(f"the dataset has no camera {wanted!r}{suggest(wanted, cameras)}")
    return wanted or cameras[0]


def _frame_size(place: Place, camera: str) -> tuple[int, int]:
    if place.video is not None:
        return video_facts(place.video).size
    height, width = next(_frames(place, camera, 1, 1)).shape[:2]
    return height, width


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


def _action(features: Mapping[str, Mapping[str, Any]], places: Sequence[Place]) -> ActionSpec:
    if ACTION not in features:
        raise DataError("the dataset has no actions, and a world model is conditioned on them")
    low, high = np.inf, -np.inf
    for path in sorted({place.data for place in places}):
        rows = _numbers(read_columns(path, [ACTION]), ACTION)
        if rows.ndim != 2 or not len(rows) or not np.all(np.isfinite(rows)):
            raise DataError(f"{path} has actions {rows.shape} or some that are not finite")
        low, high = np.minimum(low, rows.min(0)), np.maximum(high, rows.max(0))
    low, high = np.atleast_1d(low).astype(np.float64), np.atleast_1d(high).astype(np.float64)
    still = low == high  # a dimension that never moves still needs a range
    low, high = np.where(still, low - 1, low), np.where(still, high + 1, high)
    names = _names(features[ACTION])
    if len(names) != len(low):
        names = [f"action_{i}" for i in range(len(low))]
    units = ("",) * len(low)
    return ActionSpec(tuple(names), units, tuple(low.tolist()), tuple(high.tolist()), "absolute")


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


def _splits(
    info: Mapping[str, Any], episodes: int, test_episodes: int | None
) -> dict[Split, Sequence[int]]:
    chosen: dict[int, Split] = {}
    if test_episodes is None:
        for name, text in cast(dict[str, Any], info.get("splits") or {}).items():
            found = re.fullmatch(r"(\d+):(\d+)", str(text))
            if found and name in TESTS:
                numbers = range(int(found[1]), min(int(found[2]), episodes))
                chosen |= dict.fromkeys(numbers, TESTS[name])
        if not chosen:
            test_episodes = max(2, episodes // 10) if episodes > 2 else 0
    if test_episodes is not None:
        if not 0 <= test_episodes < episodes:
            raise DataError(f"{test_episodes} of {episodes} episodes cannot be set aside for tests")
        chosen = dict.fromkeys(range(episodes - test_episodes, episodes), "ind_test")
    splits: dict[Split, list[int]] = {}
    for number in range(episodes):
        splits.setdefault(chosen.get(number, "train"), []).append(number)
    return {split: _compact(numbers) for split, numbers in splits.items()}


def _compact(numbers: list[int]) -> Sequence[int]:
    """A range if there is no gap, because the numbers are sent to workers with every task."""
    whole = range(numbers[0], numbers[-1] + 1)
    return whole if len(whole) == len(numbers) else tuple(numbers)


def _facts(
    root: Path, places: Sequence[Place], splits: Mapping[Split, Sequence[int]]
) -> dict[str, Any]:
    """Facts that identify this dataset without reading all of it."""
    digest = hashlib.sha256((root / INFO).read_bytes())
    digest.update(repr([(p.episode, p.length, p.start) for p in places]).encode())
    files = {path for place in places for path in (place.data, place.video) if path}
    return {
        "sha256_of_meta": digest.hexdigest(),
        "bytes": sum(path.stat().st_size for path in files if path.is_file()),
        "episodes": {split: repr(numbers) for split, numbers in splits.items()},
    }


def _notes(
    info: Mapping[str, Any], features: Mapping[str, Mapping[str, Any]], camera: str, *, bounds: bool
) -> tuple[str, ...]:
    notes: list[str] = []
    if bounds:
        notes.append("The bounds of actions are the range of the data; units are not known.")
    others = [n for n, f in features.items() if f.get("dtype") in ("video", "image")]
    if len(others) > 1:
        notes.append(
            f"Frames of {camera}; other cameras: {', '.join(sorted({*others} - {camera}))}"
        )
    if info["fps"] != round(info["fps"]):
        notes.append(f"{info['fps']} frames per second, rounded to {round(info['fps'])}.")
    return tuple(notes)
