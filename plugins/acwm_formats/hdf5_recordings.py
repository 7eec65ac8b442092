"""The episodes of HDF5 files, opened on request."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError
from acwm_core.files import parse_json
from acwm_formats.frames import ImageFrames, file_stamp, regular_times
from acwm_formats.hdf5_layouts import Layout, array, opened
from acwm_formats.labels import Labels
from acwm_formats.timeline import Samples, TimedRecording


@dataclass(frozen=True)
class HDF5Recordings:
    """Episodes by file and group.

    Attributes:
        places: the file and the group of each.
        layout: where things lie in the group.
        rate: frames per second.
        pixel_range: values that are black and white, see `images.to_rgb`.
    """

    places: Mapping[int, tuple[Path, str]]
    layout: Layout
    rate: Fraction
    pixel_range: tuple[float, float] | None = None

    def __len__(self) -> int:
        """The number of episodes."""
        return len(self.places)

    def part(self, indices: Sequence[int]) -> HDF5Recordings:
        """The same, with the places of some episodes."""
        return replace(self, places={index: self.places[index] for index in indices})

    def __getitem__(self, index: int) -> TimedRecording:
        """Open one episode."""
        path, name = self.places[index]
        ours = self.layout.name == "acwm"
        try:
            group = _file(path, file_stamp(path))[name]
            actions = rows(array(group, self.layout.actions))
            states = {
                state: Samples(rows(array(group, where)))
                for state, where in self.layout.states.items()
            }
            cameras = {
                camera: self._frames(path, f"{name}/{where}", len(array(group, where)))
                for camera, where in self.layout.cameras.items()
            }
            labels, facts = (_labels(path, group), _facts(group)) if ours else (None, {})
        except (OSError, KeyError, RuntimeError, ValueError) as error:
            raise DataError(f"{path} cannot be read ({error})") from error
        title = path.name if name == "/" else f"{path.name} {name}"
        return TimedRecording(
            title, cameras, Samples(actions), states, self.rate, facts=facts, labels=labels
        )

    def _frames(self, path: Path, name: str, count: int) -> ImageFrames:
        times = regular_times(count, self.rate)
        stamp = f"{name} {file_stamp(path)}"
        return ImageFrames(StoredImages(path, name, count), times, self.pixel_range, stamp=stamp)


def _labels(path: Path, group: Any) -> Labels:
    masks = StoredImages(path, f"{group.name}/masks", len(array(group, "masks")))
    return Labels(masks, np.asarray(array(group, "contacts")[()], np.int32).reshape(-1, 3))


def _facts(group: Any) -> dict[str, Any]:
    """What our export knows of an episode, with the factors and the shift of a simulated one."""
    simulated = {
        "factors": parse_json(group.attrs.get("factors", "{}")),
        "ood_label": group.attrs.get("ood_label", ""),
    }
    facts = parse_json(group.attrs.get("facts", "{}"))
    return {name: value for name, value in simulated.items() if value} | facts


@dataclass(frozen=True)
class StoredImages(Sequence[Any]):
    """The images of a dataset, read one by one; rows of bytes are files of pictures."""

    path: Path
    name: str
    length: int

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: Any) -> Any:
        try:
            image = _file(self.path, file_stamp(self.path))[self.name][index]
        except (OSError, KeyError, RuntimeError, ValueError) as error:
            raise DataError(f"{self.path} cannot be read ({error})") from error
        if isinstance(image, bytes):
            return image
        return image.tobytes() if image.ndim == 1 and image.dtype == np.uint8 else image


def rows(found: Any) -> NDArray[Any]:
    """Numbers with a row per frame, ``[N, …]``.

    Raises:
        DataError: they are no numbers.
    """
    if found.dtype.kind not in "fiub":
        raise DataError(f"{found.name} of {found.file.filename} holds {found.dtype}, no numbers")
    values = found[()]
    return values[:, None] if values.ndim == 1 else values


@functools.lru_cache(maxsize=2)
def _file(path: Path, _: str) -> Any:
    """A file stays open while its episodes are read."""
    return opened(path)
