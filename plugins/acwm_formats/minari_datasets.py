"""The format Minari: datasets of Gymnasium whose observations hold images."""

from __future__ import annotations

import contextlib
import functools
import importlib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple, cast

import gymnasium
import h5py
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary, Text
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from minari.serialization import deserialize_space
from numpy.typing import NDArray

from acwm_core.errors import DataError, suggest
from acwm_core.files import check_fetched, parse_json
from acwm_formats.arrow_files import check_arrow
from acwm_formats.channels import Channels, named
from acwm_formats.format import Format
from acwm_formats.frames import ImageFrames, Images, file_stamp, regular_times, stack_note
from acwm_formats.hdf5_layouts import array, values_of
from acwm_formats.hdf5_store import HDF5Group, shared_file
from acwm_formats.images import CHANNELS
from acwm_formats.names import exact, natural, pair, typed, word
from acwm_formats.sources import damage_of, files_in, guarded
from acwm_formats.tables import MOST_COLUMNS, read_parquet
from acwm_formats.texts import text_facts, text_note
from acwm_formats.timeline import ActionFacts, RecordedDataset, Samples, TimedRecording

METADATA = "metadata.json"
OWN = "minari_version"
SAME_COUNT = (
    "it has as many observations as steps, so its last action leads to no "
    "frame; if each observation follows its action, give --shift -1"
)
MAIN = "main_data.hdf5"


class Minari(Format):
    """Minari datasets with images in their observations; read only."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether there is the metadata of Minari, in the folder or in data below it."""
        try:
            return OWN in _metadata(path)
        except DataError:
            return False

    @guarded
    def read(
        self,
        root: Path,
        *,
        video: str | None = None,
        rate: float | None = None,
        pixel_range: tuple[int, ...] | None = None,
        channels: Channels | None = None,
        follow_links: bool = False,
    ) -> RecordedDataset:
        """Import a Minari dataset, whose observations are or contain images.

        Args:
            root: the dataset's folder, in which data lies.
            video: Name of the images, if observations are a dict; the first by default.
            rate: Frames per second; by default those of the environment's spec, if it has them.
            pixel_range: Values that are black and white, e.g. 0,1.
            channels: What four channels are (rgba), or which of stacked grey frames is the newest.
            follow_links: Whether links may lead out of the folder.
        """
        root = Path(root)
        within = None if follow_links else root
        stored = _stored(root, within)
        metadata, parts = stored.metadata, _parts(stored.observations)
        cameras = {name: space for name, space in parts.items() if _shows(space)}
        if video is not None and video not in cameras:
            raise DataError(f"{root} has no images {video!r}{suggest(video, cameras)}")
        if not cameras:
            raise DataError(
                f"the observations of {root} hold no image: {stored.observations!s:.200}"
            )
        said = exact(rate) if rate else _rate(metadata)
        if said is None:
            raise DataError(f"{root} does not state its frame rate: give --rate")
        names = tuple(cameras) if video is None else (video,)
        recordings = MinariRecordings(root, names, said, pair(pixel_range), channels, within)
        return RecordedDataset(
            name=word(root.parent if root.name == "data" else root),
            splits=recordings,
            facts={"kind": "minari", "name": str(metadata.get("dataset_id", root.name))}
            | {"episodes": len(stored.episodes), "steps": int(metadata.get("total_steps", 0))},
            options={"video": video, "rate": rate, "pixel_range": typed(pixel_range)}
            | {"channels": channels, "follow_links": follow_links},
            actions=_action(stored.actions),
            notes=_notes(recordings, [name for name in cameras if name not in names]),
            summary=str(metadata.get("description") or "A dataset of Minari"),
        )

    @classmethod
    def example(cls, folder: Path) -> dict[str, Any]:
        """A dataset of three short episodes of noise."""
        images = Box(0, 255, (32, 32, 3), np.uint8)
        space, rng = gymnasium.spaces.Dict({"camera": images}), np.random.default_rng(0)
        acts = Box(-1, 1, (2,), np.float32)
        place = folder / "noise" / "data"
        place.mkdir(parents=True)
        storage = MinariStorage.new(place, observation_space=space, action_space=acts)
        for length in (5, 6, 7):
            observations = {"camera": rng.integers(0, 256, (length + 1, 32, 32, 3), np.uint8)}
            actions: Any = rng.uniform(-1, 1, (length, 2)).astype(np.float32)
            ends = [False] * length
            storage.update_episodes(
                [
                    EpisodeBuffer(
                        observations=observations,
                        actions=actions,
                        rewards=[0.0] * length,
                        terminations=ends,
                        truncations=ends,
                    )
                ]
            )
        storage.update_metadata({"dataset_id": "example/noise-v0", "minari_version": "0.5.0"})
        return {"root": place.parent, "rate": 10.0}


@dataclass(frozen=True)
class MinariRecordings:
    """The episodes of a dataset, opened on request; see `open_hdf5` for `within`."""

    root: Path
    cameras: tuple[str, ...]
    rate: Fraction
    pixel_range: tuple[float, float] | None
    channels: Channels | None
    within: Path | None

    def __len__(self) -> int:
        """The number of episodes."""
        return len(_stored(self.root, self.within).episodes)

    def __getitem__(self, index: int) -> TimedRecording:
        """Open one episode: the observations, and an action from each to the next."""
        stored = _stored(self.root, self.within)
        title = f"episode {stored.episodes[index].removeprefix('episode_')}"
        with damage_of(f"{title} of {self.root}"):
            read = _from_hdf5 if stored.kind == "hdf5" else _from_arrow
            seen, taken = read(_data(self.root), stored, index, self.within)
            cameras = {
                name: self._frames(cast(Images, seen[name]), name, index) for name in self.cameras
            }
            states = {
                name: Samples(values.reshape(len(values), -1))
                for name, values in seen.items()
                if isinstance(values, np.ndarray) and values.ndim <= 2
            }
            actions = Samples(_vectors(taken, stored.actions))
            count = len(next(iter(cameras.values())).images)
            facts = text_facts({n: rows for n, rows in seen.items() if isinstance(rows, list)})
            notes = (SAME_COUNT,) if len(actions.values) == count else ()
            return TimedRecording(
                title, cameras, actions, states, self.rate, facts=facts, notes=notes
            )

    def _frames(self, images: Images, name: str, index: int) -> ImageFrames:
        times = regular_times(len(images), self.rate)
        stamp = f"{index} {name} {file_stamp(_data(self.root) / METADATA)}"
        channels = named(name, self.channels)
        return ImageFrames(images, times, self.pixel_range, channels=channels, stamp=stamp)


def _notes(recordings: MinariRecordings, others: Sequence[str]) -> tuple[str, ...]:
    """What people should know about how the dataset was read."""
    notes = [f"Images that were left out: {', '.join(others)} (--video NAME)."] if others else []
    with contextlib.suppress(DataError, IndexError):
        first = recordings[0]
        notes += [*stack_note(first.cameras.values()), *text_note(first.facts)]
    return tuple(notes)


class _Stored(NamedTuple):
    """What a dataset says about itself.

    Attributes:
        metadata: the content of its file of metadata.
        kind: how its arrays are stored: hdf5, arrow or parquet.
        observations, actions: their spaces.
        episodes: their names, in natural order.
    """

    metadata: Mapping[str, Any]
    kind: str
    observations: Any
    actions: Any
    episodes: tuple[str, ...]


_Seen = dict[str, NDArray[Any] | Images | list[str]]
"""Observations of an episode by name; images may be files of pictures, which are read here, because
the library hands them to whatever Pillow takes them for."""


def _data(root: Path) -> Path:
    return root / "data" if (root / "data" / METADATA).is_file() else root


def _metadata(root: Path) -> dict[str, Any]:
    path = _data(root) / METADATA
    check_fetched(path)
    try:
        return dict(parse_json(path.read_bytes()))
    except (OSError, ValueError, TypeError) as error:
        raise DataError(f"{path} cannot be read ({error})") from error


def _stored(root: Path, within: Path | None) -> _Stored:
    return _described(root, within, file_stamp(_data(root) / METADATA))


@functools.lru_cache(maxsize=2)
def _described(root: Path, within: Path | None, _: str) -> _Stored:
    """What a dataset says about itself.

    Raises:
        DataError: it is damaged; or does not say the spaces, which the library would get by making
            the environment that they name, and files are never code.
    """
    metadata, data = _metadata(root), _data(root)
    if not {"observation_space", "action_space"} <= set(metadata):
        raise DataError(f"{root} does not state its spaces: write it again with a recent Minari")
    kind = metadata.get("data_format", "hdf5")
    if kind not in ("hdf5", "arrow", "parquet"):
        raise DataError(f"{root} stores its arrays as {kind!r:.40}, not as hdf5, arrow or parquet")
    with damage_of(data / METADATA):
        seen = deserialize_space(metadata["observation_space"])
        acts = deserialize_space(metadata["action_space"])
        claimed = int(metadata["total_episodes"])
    names = (
        [*shared_file(data / MAIN, within)] if kind == "hdf5" else [p.name for p in data.iterdir()]
    )
    pattern = r"episode_\d+" if kind == "hdf5" else r"\d+"
    there = sorted((name for name in names if re.fullmatch(pattern, name)), key=natural)
    last = int(there[-1].removeprefix("episode_")) if there else -1
    if claimed not in (len(there), last + 1):  # which differ if some were removed
        many = f"{claimed:,} episodes, and {len(there):,} are there"
        raise DataError(f"{data / METADATA} claims {many}")
    return _Stored(metadata, kind, seen, acts, tuple(there))


def _from_hdf5(
    data: Path, stored: _Stored, index: int, within: Path | None
) -> tuple[_Seen, NDArray[Any]]:
    """Observations and actions of an episode; images are read when they are asked for."""
    arrays = HDF5Group(data / MAIN, stored.episodes[index], within)
    group = arrays.group
    is_dict, seen = isinstance(stored.observations, gymnasium.spaces.Dict), _Seen()
    for name, space in _parts(stored.observations).items():
        where = f"observations/{name}" if is_dict else "observations"
        if _shows(space):
            seen[name] = arrays.images(where)
        elif isinstance(space, Text):
            seen[name] = [bytes(text).decode() for text in values_of(array(group, where))]
        elif isinstance(group.get(where), h5py.Dataset) and group[where].dtype.kind in "fiub":
            seen[name] = arrays.rows(where)
    return seen, arrays.rows("actions")


def _from_arrow(
    data: Path, stored: _Stored, index: int, _: Path | None
) -> tuple[_Seen, NDArray[Any]]:
    """Observations and actions of an episode, which is a folder of files; the last row has none."""
    arrow: Any = importlib.import_module("pyarrow")
    dataset: Any = importlib.import_module("pyarrow.dataset")
    files = files_in(data / stored.episodes[index], [f".{stored.kind}"])
    for path in files:
        check_fetched(path)
        if stored.kind == "arrow":
            check_arrow(path)
    names = ["observations", "actions"]
    if stored.kind == "parquet":
        table = arrow.concat_tables([read_parquet(path, names) for path in files])
    else:
        table = dataset.dataset([*map(str, files)], format=stored.kind).to_table(names)
    column = table.column("observations").combine_chunks()
    is_dict, seen = isinstance(stored.observations, gymnasium.spaces.Dict), _Seen()
    for name, space in _parts(stored.observations).items():
        if isinstance(space, Box | Discrete | MultiBinary | Text):
            seen[name] = _unpacked(column.field(name) if is_dict else column, space)
    actions = _unpacked(table.column("actions").combine_chunks(), stored.actions)
    return seen, np.asarray(actions)[:-1]


def _unpacked(values: Any, space: Any) -> NDArray[Any] | list[bytes] | list[str]:
    """The rows of an Arrow array: texts, files of pictures, or numbers in the space's shape."""
    if str(values.type).endswith(("binary", "string")):
        return values.to_pylist()
    flat = values.flatten() if str(values.type).startswith("fixed_size_list") else values
    return flat.to_numpy(zero_copy_only=False).reshape(-1, *space.shape)


def _parts(observed: Any) -> dict[str, Any]:
    """The spaces of a dict of observations, or the only one."""
    is_dict = isinstance(observed, gymnasium.spaces.Dict)
    return dict(observed.spaces) if is_dict else {"observation": observed}


def _shows(space: Any) -> bool:
    shape = space.shape if isinstance(space, Box) else ()
    return len(shape) == 3 and (shape[0] in CHANNELS or shape[2] in CHANNELS)


def _rate(metadata: Mapping[str, Any]) -> Fraction | None:
    try:
        spec = parse_json(metadata["env_spec"])
        return exact(float(spec["kwargs"]["render_fps"]))
    except (KeyError, ValueError, TypeError):
        return None


def _action(space: Any) -> ActionFacts:
    wide = space.n if isinstance(space, Discrete) else math.prod(space.shape or ())
    if wide > MOST_COLUMNS:
        raise DataError(f"its actions are {wide:,} numbers, but at most {MOST_COLUMNS:,} are read")
    if isinstance(space, Discrete):
        count, start = int(space.n), int(space.start)
        names = tuple(f"action_{start + place}" for place in range(count))
        return ActionFacts(names, bounds=((0.0,) * count, (1.0,) * count))
    if isinstance(space, MultiBinary):
        count = int(np.prod(space.shape))
        return ActionFacts(bounds=((0.0,) * count, (1.0,) * count))
    if not isinstance(space, Box):
        kind = type(space).__name__
        raise DataError(f"its actions are {kind}; Box, Discrete and MultiBinary can be read")
    low, high = (np.asarray(bound, np.float64).reshape(-1) for bound in (space.low, space.high))
    if not np.all(np.isfinite([low, high])) or not np.all(low < high):
        return ActionFacts()
    return ActionFacts(bounds=(tuple(low.tolist()), tuple(high.tolist())))


def _vectors(actions: Any, space: Any) -> NDArray[Any]:
    """Actions ``[N, A]``; discrete ones as one-hot vectors."""
    values = np.asarray(actions)
    if isinstance(space, Discrete):
        return np.eye(int(space.n), dtype=np.float32)[values.reshape(-1) - int(space.start)]
    return values.reshape(len(values), -1)
