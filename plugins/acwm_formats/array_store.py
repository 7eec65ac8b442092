"""Episodes in files of arrays, such as HDF5 and Zarr, read through one interface."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from acwm_core.env.card import ActionKind
from acwm_core.errors import DataError
from acwm_formats.channels import Channels, named
from acwm_formats.frames import ImageFrames, regular_times
from acwm_formats.labels import Labels
from acwm_formats.sources import damage_of
from acwm_formats.timeline import Samples, TimedRecording


class ArrayStore(ABC):
    """Arrays by name in a file, or in a group of one; opened when they are read."""

    path: Path
    title = ""  # what the owner of its only episode knows it by
    stamp = ""  # what identifies the content of the file

    @abstractmethod
    def length(self, name: str) -> int:
        """The number of rows of an array."""

    @abstractmethod
    def rows(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Numbers with a row per frame, ``[N, …]``."""

    def images(self, name: str, start: int = 0, stop: int | None = None) -> StoredImages:
        """The images in an array, from `start` to `stop` or to its end."""
        count = self.length(name)
        end = count if stop is None else min(stop, count)
        return StoredImages(self, name, start, max(start, end))

    def image(self, name: str, index: int) -> NDArray[Any] | bytes:
        """One row as an image, or as the file of a picture."""
        return self.rows(name, index, index + 1)[0]

    def description(self, episode: StoredEpisode) -> tuple[dict[str, Any], Labels | None]:
        """Facts of one of its episodes, and labels of the frames."""
        return {}, None


@dataclass(frozen=True)
class ArrayLayout:
    """The paths of an episode's arrays.

    Attributes:
        name: whose layout it is.
        cameras: path of the frames by the name of the camera.
        actions: path of the actions.
        states: path of each state by its name.
        rate: frames per second; None if the files do not say it.
        kind: what actions command; None if the files do not say it.
        note: a sentence for people.
        held: dimensions of the actions that are absolute in every case, such as a gripper's.
    """

    name: str
    cameras: Mapping[str, str]
    actions: str
    states: Mapping[str, str] = field(default_factory=dict[str, str])
    rate: Fraction | None = None
    kind: ActionKind | None = None
    note: str = ""
    held: tuple[int, ...] = ()

    @property
    def is_robosuite(self) -> bool:
        """Whether its actions are a robosuite controller's, most of which take steps."""
        return self.name in ("robomimic", "LIBERO")


@dataclass(frozen=True)
class StoredEpisode:
    """One episode of a store.

    Attributes:
        arrays: the arrays that it is in.
        number: its number among the episodes in the same arrays; None if it is the only one.
        count: how many these are.
        start, stop: its rows; all by default.
        problem: why it cannot be opened; empty if it can.
    """

    arrays: ArrayStore
    number: int | None = None
    count: int = 1
    start: int = 0
    stop: int | None = None
    problem: str = ""

    @property
    def title(self) -> str:
        """What its owner knows it by."""
        number = "" if self.number is None else f" episode {self.number}"
        return f"{self.arrays.title}{number}".strip()


@dataclass(frozen=True)
class StoredEpisodes:
    """Episodes of stores with the same layout, opened on request.

    Attributes:
        episodes: each by its number.
        layout: the paths of their arrays.
        rate: frames per second.
        pixel_range: values that are black and white, see `images.to_rgb`.
        channels: what three or four channels are; found out by default.
    """

    episodes: Mapping[int, StoredEpisode]
    layout: ArrayLayout
    rate: Fraction
    pixel_range: tuple[float, float] | None = None
    channels: Channels | None = None

    def __len__(self) -> int:
        """The number of episodes."""
        return len(self.episodes)

    def part(self, indices: Sequence[int]) -> StoredEpisodes:
        """The same, with some of the episodes."""
        return replace(self, episodes={index: self.episodes[index] for index in indices})

    def __getitem__(self, index: int) -> TimedRecording:
        """Open one episode."""
        episode, arrays = self.episodes[index], self.episodes[index].arrays
        if episode.problem:
            raise DataError(episode.problem)

        def rows(name: str) -> Samples:
            return Samples(arrays.rows(name, episode.start, episode.stop))

        with damage_of(arrays.path):
            actions = rows(self.layout.actions)
            states = {state: rows(name) for state, name in self.layout.states.items()}
            cameras = {
                camera: self._frames(episode, name) for camera, name in self.layout.cameras.items()
            }
            facts, labels = arrays.description(episode)
        return TimedRecording(
            episode.title, cameras, actions, states, self.rate, facts=facts, labels=labels
        )

    def _frames(self, episode: StoredEpisode, name: str) -> ImageFrames:
        arrays, start, stop = episode.arrays, episode.start, episode.stop
        images = arrays.images(name, start, stop)
        return ImageFrames(
            images,
            regular_times(len(images), self.rate),
            self.pixel_range,
            channels=named(name, self.channels),
            stamp=f"{episode.title} {name} {start} {stop} {arrays.stamp}",
        )


@dataclass(frozen=True)
class StoredImages(Sequence[Any]):
    """Rows `start` to `stop` of an array as images, read one by one."""

    arrays: ArrayStore
    name: str
    start: int
    stop: int

    def __len__(self) -> int:
        return self.stop - self.start

    def __getitem__(self, index: Any) -> Any:
        with damage_of(self.arrays.path):
            return self.arrays.image(self.name, self.start + index)
