"""The episodes of HDF5 files, opened on request."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError
from acwm_core.files import parse_json
from acwm_formats.channels import Channels, named
from acwm_formats.frames import ImageFrames, file_stamp, regular_times
from acwm_formats.hdf5_layouts import Layout, array, content, opened
from acwm_formats.labels import Labels
from acwm_formats.sources import damage_of
from acwm_formats.timeline import Samples, TimedRecording

LONGEST = 1000  # characters of a text that is kept


class Place(NamedTuple):
    """Where one episode lies.

    Attributes:
        path: the file.
        group: the name of its group.
        number: its place among the episodes in the rows of the group; None if it is the only one.
        start, stop: its rows; all by default.
        problem: why it cannot be opened; empty if it can.
    """

    path: Path
    group: str
    number: int | None = None
    start: int = 0
    stop: int | None = None
    problem: str = ""

    @property
    def title(self) -> str:
        """What its owner knows it by."""
        group = "" if self.group == "/" else f" {self.group}"
        number = "" if self.number is None else f" episode {self.number}"
        return f"{self.path.name}{group}{number}"


@dataclass(frozen=True)
class HDF5Recordings:
    """Episodes by file, group and rows.

    Attributes:
        places: where each lies.
        layout: where things lie in the group.
        rate: frames per second.
        pixel_range: values that are black and white, see `images.to_rgb`.
    """

    places: Mapping[int, Place]
    layout: Layout
    rate: Fraction
    pixel_range: tuple[float, float] | None = None
    channels: Channels | None = None

    def __len__(self) -> int:
        """The number of episodes."""
        return len(self.places)

    def part(self, indices: Sequence[int]) -> HDF5Recordings:
        """The same, with the places of some episodes."""
        return replace(self, places={index: self.places[index] for index in indices})

    def __getitem__(self, index: int) -> TimedRecording:
        """Open one episode."""
        place, path = self.places[index], self.places[index].path
        if place.problem:
            raise DataError(place.problem)
        ours = self.layout.name == "acwm"
        with damage_of(path):
            group = shared_file(path)[place.group]
            actions = rows(array(group, self.layout.actions), place)
            states = {
                state: Samples(rows(array(group, where), place))
                for state, where in self.layout.states.items()
            }
            cameras = {
                camera: self._frames(place, where, len(array(group, where)))
                for camera, where in self.layout.cameras.items()
            }
            labels, facts = (_labels(path, group), _facts(group)) if ours else (None, texts(group))
        return TimedRecording(
            place.title, cameras, Samples(actions), states, self.rate, facts=facts, labels=labels
        )

    def _frames(self, place: Place, where: str, count: int) -> ImageFrames:
        stop = count if place.stop is None else place.stop
        name = f"{place.group}/{where}"
        images = StoredImages(place.path, name, max(0, min(stop, count) - place.start), place.start)
        rows = "" if place.number is None else f" {place.start} {stop}"
        return ImageFrames(
            images,
            regular_times(len(images), self.rate),
            self.pixel_range,
            channels=named(where, self.channels),
            stamp=f"{name}{rows} {file_stamp(place.path)}",
        )


def _labels(path: Path, group: Any) -> Labels:
    masks = StoredImages(path, f"{group.name}/masks", len(array(group, "masks")))
    contacts = np.asarray(content(array(group, "contacts")), np.int32)
    return Labels(masks, contacts.reshape(-1, 3))


def _facts(group: Any) -> dict[str, Any]:
    """What our export knows of an episode, with the factors and the shift of a simulated one."""
    simulated = {
        "factors": parse_json(group.attrs.get("factors", "{}")),
        "ood_label": group.attrs.get("ood_label", ""),
    }
    facts = parse_json(group.attrs.get("facts", "{}"))
    return {name: value for name, value in simulated.items() if value} | facts


def texts(group: Any) -> dict[str, str]:
    """The texts that describe an episode: attributes of its group, and arrays of one text.

    Long ones, such as the source of a simulator's model, are left out.
    """
    found: dict[str, str] = {}
    items = [*group.attrs.items()] + [
        (name, content(item) if item.ndim == 0 else content(item)[0])
        for name, item in group.items()
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "SO" and item.size == 1
    ]
    try:  # of LIBERO, where it is the same for all
        told = parse_json(group.parent.attrs["problem_info"])
        items.append(("language_instruction", told["language_instruction"]))
    except (KeyError, TypeError, ValueError):
        pass
    for name, value in items:
        text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        if isinstance(text, str) and 0 < len(text) <= LONGEST:
            found[name] = text
    return found


@dataclass(frozen=True)
class StoredImages(Sequence[Any]):
    """The images of a dataset, from `first` on; rows of bytes are files of pictures."""

    path: Path
    name: str
    length: int
    first: int = 0

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: Any) -> Any:
        with damage_of(self.path):
            image = shared_file(self.path)[self.name][self.first + index]
        if isinstance(image, bytes):
            return image
        return image.tobytes() if image.ndim == 1 and image.dtype == np.uint8 else image


def rows(found: Any, place: Place) -> NDArray[Any]:
    """Numbers with a row per frame, ``[N, …]``, of one episode.

    Raises:
        DataError: they are no numbers.
        ValueError: they are far more than the file stores.
    """
    if found.dtype.kind not in "fiub":
        raise DataError(f"{found.name} of {found.file.filename} holds {found.dtype}, no numbers")
    values = content(found, slice(place.start, place.stop))
    return values[:, None] if values.ndim == 1 else values


def shared_file(path: Path) -> Any:
    """An HDF5 file, which stays open while its episodes are read; errors as in `opened`."""
    return _file(path, file_stamp(path))


@functools.lru_cache(maxsize=2)
def _file(path: Path, _: str) -> Any:
    return opened(path)
