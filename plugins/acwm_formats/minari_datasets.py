"""The format Minari: datasets of Gymnasium whose observations hold images."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete, MultiBinary
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage
from numpy.typing import NDArray

from acwm_core.errors import DataError, suggest
from acwm_core.files import parse_json
from acwm_formats.channels import Channels
from acwm_formats.format import Format
from acwm_formats.frames import ImageFrames, file_stamp, regular_times, stack_note
from acwm_formats.images import CHANNELS
from acwm_formats.names import exact, pair, text_note, typed, word
from acwm_formats.timeline import ActionFacts, RecordedDataset, Samples, TimedRecording

METADATA = "metadata.json"
OWN = "minari_version"
SAME_COUNT = (
    "it has as many observations as steps, so its last action leads to no frame, unless each "
    "observation is the one after its action: then --shift -1 is right"
)
BROKEN = (OSError, ValueError, KeyError, TypeError, AssertionError, RuntimeError, IndexError)
"""Exceptions of the library for files that are damaged."""


class Minari(Format):
    """Minari datasets with images in their observations; only read."""

    @classmethod
    def detect(cls, path: Path) -> bool:
        """Whether there is the metadata of Minari, in the folder or in data below it."""
        try:
            return OWN in parse_json((_data(path) / METADATA).read_bytes())
        except (OSError, ValueError, TypeError):
            return False

    def read(
        self,
        root: Path,
        *,
        video: str | None = None,
        rate: float | None = None,
        pixel_range: tuple[int, ...] | None = None,
        channels: Channels | None = None,
    ) -> RecordedDataset:
        """Import a Minari dataset, whose observations are images or have some.

        Args:
            root: the dataset's folder, in which data lies.
            video: Name of the images, if observations are a dict; the first by default.
            rate: Frames per second; by default those of the environment's spec, if it says them.
            pixel_range: Values that are black and white, e.g. 0,1.
            channels: What four channels are (rgba), or which of stacked grey frames is the newest.
        """
        root = Path(root)
        storage, metadata = _storage(root), _metadata(root)
        cameras = {name: s for name, s in _parts(storage.observation_space).items() if _shows(s)}
        if video is not None and video not in cameras:
            raise DataError(f"{root} has no images {video!r}{suggest(video, cameras)}")
        if not cameras:
            raise DataError(
                f"the observations of {root} hold no image: {_parts(storage.observation_space)}"
            )
        said = exact(rate) if rate else _rate(metadata)
        if said is None:
            raise DataError(f"{root} does not say how many frames it has per second: give --rate")
        names = tuple(cameras) if video is None else (video,)
        recordings = MinariRecordings(root, names, said, pair(pixel_range), channels)
        return RecordedDataset(
            name=word(root.parent if root.name == "data" else root),
            splits=recordings,
            facts={"kind": "minari", "name": str(metadata.get("dataset_id", root.name))}
            | {"episodes": int(storage.total_episodes), "steps": int(storage.total_steps)},
            options={"video": video, "rate": rate, "pixel_range": typed(pixel_range)}
            | {"channels": channels},
            actions=_action(storage.action_space),
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
    """The episodes of a dataset, opened on request."""

    root: Path
    cameras: tuple[str, ...]
    rate: Fraction
    pixel_range: tuple[float, float] | None
    channels: Channels | None = None

    def __len__(self) -> int:
        """The number of episodes."""
        return int(_storage(self.root).total_episodes)

    def __getitem__(self, index: int) -> TimedRecording:
        """Open one episode: the observations, and an action from each to the next."""
        episode = _episode(self.root, index)
        space = _storage(self.root).action_space
        seen = _parts(episode["observations"])
        cameras = {
            name: ImageFrames(
                StoredImages(self.root, index, name, len(seen[name])),
                regular_times(len(seen[name]), self.rate),
                self.pixel_range,
                channels=self.channels,
                stamp=f"{index} {name} {file_stamp(_data(self.root) / METADATA)}",
            )
            for name in self.cameras
        }
        states = {
            name: Samples(np.reshape(values, (len(values), -1)))
            for name, values in seen.items()
            if name not in self.cameras
            and np.ndim(values) <= 2
            and np.asarray(values).dtype.kind in "fiub"
        }
        actions = Samples(_vectors(episode["actions"], space))
        count = len(next(iter(cameras.values())).images)
        notes = (SAME_COUNT,) if len(actions.values) == count else ()
        return TimedRecording(
            f"episode {index}",
            cameras,
            actions,
            states,
            self.rate,
            facts=_texts(seen),
            notes=notes,
        )


def _texts(seen: Mapping[str, Any]) -> dict[str, Any]:
    """Observed texts: one, or those that follow each other."""
    found: dict[str, Any] = {}
    for name, values in seen.items():
        if np.asarray(values).dtype.kind in "UO" and all(isinstance(v, str) for v in values):
            each = list(dict.fromkeys(map(str, values)))
            found[name] = each[0] if len(each) == 1 else each
    return found


def _notes(recordings: MinariRecordings, others: Sequence[str]) -> tuple[str, ...]:
    """What people should know about how the dataset was read."""
    notes = [f"Images that were left out: {', '.join(others)} (--video NAME)."] if others else []
    with contextlib.suppress(DataError, IndexError):
        first = recordings[0]
        notes += [*stack_note(first.cameras.values()), *text_note(first.facts)]
    return tuple(notes)


@dataclass(frozen=True)
class StoredImages(Sequence[Any]):
    """The images of one episode."""

    root: Path
    episode: int
    name: str
    length: int

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: Any) -> Any:
        return _parts(_episode(self.root, self.episode)["observations"])[self.name][index]


def _data(root: Path) -> Path:
    return root / "data" if (root / "data" / METADATA).is_file() else root


def _metadata(root: Path) -> dict[str, Any]:
    try:
        return parse_json((_data(root) / METADATA).read_bytes())
    except (OSError, ValueError) as error:
        raise DataError(f"{_data(root) / METADATA} cannot be read ({error})") from error


def _storage(root: Path) -> Any:
    return _opened(root, file_stamp(_data(root) / METADATA))


@functools.lru_cache(maxsize=2)
def _opened(root: Path, _: str) -> Any:
    """The library's reader of the files.

    Raises:
        DataError: they are damaged; or do not say the spaces, which the library would get by making
            the environment that they name, and files are never code.
    """
    metadata = _metadata(root)
    if not {"observation_space", "action_space"} <= set(metadata):
        raise DataError(f"{root} does not say its spaces: write it again with a recent Minari")
    try:
        return MinariStorage.read(_data(root).absolute())
    except BROKEN as error:
        raise DataError(f"{root} is no Minari dataset that can be read ({error})") from error


def _episode(root: Path, index: int) -> dict[str, Any]:
    return _loaded(_storage(root), index)


@functools.lru_cache(maxsize=2)
def _loaded(storage: Any, index: int) -> dict[str, Any]:
    """The library reads an episode as a whole; it is kept for its frames."""
    try:
        (episode,) = storage.get_episodes([index])
    except BROKEN as error:
        raise DataError(f"episode {index} cannot be read ({error})") from error
    return episode


def _parts(observed: Any) -> dict[str, Any]:
    """The entries of a dict of observations or spaces, or the only one."""
    if isinstance(observed, gymnasium.spaces.Dict):
        return dict(observed.spaces)
    return dict(observed) if isinstance(observed, dict) else {"observation": observed}


def _shows(space: Any) -> bool:
    shape = space.shape if isinstance(space, Box) else ()
    return len(shape) == 3 and (shape[0] in CHANNELS or shape[2] in CHANNELS)


def _rate(metadata: dict[str, Any]) -> Fraction | None:
    try:
        spec = parse_json(metadata["env_spec"])
        return exact(float(spec["kwargs"]["render_fps"]))
    except (KeyError, ValueError, TypeError):
        return None


def _action(space: Any) -> ActionFacts:
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
