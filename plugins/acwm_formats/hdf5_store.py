"""The arrays and facts of an episode in an HDF5 file, which stays open while it is read."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError
from acwm_core.files import parse_json
from acwm_formats.array_store import ArrayStore, StoredEpisode
from acwm_formats.episode_bounds import INDEX
from acwm_formats.frames import file_stamp
from acwm_formats.hdf5_chunks import check_chunks
from acwm_formats.hdf5_layouts import array, open_hdf5, values_of
from acwm_formats.labels import Labels
from acwm_formats.texts import LONGEST, Fact, text_facts


@dataclass(frozen=True)
class HDF5Group(ArrayStore):
    """The arrays in the group `name` of a file; see `open_hdf5` for `within`."""

    path: Path
    name: str
    within: Path | None

    @property
    def group(self) -> Any:
        """The group in its file, which stays open."""
        return shared_file(self.path, self.within)[self.name]

    @property
    def title(self) -> str:
        """As in `ArrayStore`."""
        return self.path.name + ("" if self.name == "/" else f" {self.name}")

    @property
    def stamp(self) -> str:
        """As in `ArrayStore`."""
        return file_stamp(self.path)

    def length(self, name: str) -> int:
        """As in `ArrayStore`; raises as `hdf5_layouts.array`."""
        return len(array(self.group, name))

    def rows(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """As in `ArrayStore`.

        Raises:
            DataError: there is no such array, or it holds no numbers.
            ValueError: they are far more than the file stores.
        """
        stored = array(self.group, name)
        if stored.dtype.kind not in "fiub":
            raise DataError(
                f"{stored.name} of {stored.file.filename} holds {stored.dtype}, not numbers"
            )
        values = values_of(stored, slice(start, stop))
        return values[:, None] if values.ndim == 1 else values

    def image(self, name: str, index: int) -> NDArray[Any] | bytes:
        """As in `ArrayStore`; rows of bytes are files of pictures."""
        stored = self.group[name]
        check_chunks(stored, slice(index, index + 1))
        image = stored[index]
        if isinstance(image, bytes):
            return image
        return image.tobytes() if image.ndim == 1 and image.dtype == np.uint8 else image

    def description(self, episode: StoredEpisode) -> tuple[dict[str, Any], Labels | None]:
        """As in `ArrayStore`."""
        group = self.group
        if group.file.attrs.get("format") != "acwm":
            return _texts(group, episode), None
        contacts = np.asarray(values_of(array(group, "contacts")), np.int32).reshape(-1, 3)
        return _facts(group), Labels(self.images("masks"), contacts)


def _facts(group: Any) -> dict[str, Any]:
    """What our export knows of an episode, with the factors and the shift of a simulated one."""
    simulated = {
        "factors": parse_json(group.attrs.get("factors", "{}")),
        "ood_label": group.attrs.get("ood_label", ""),
    }
    facts = parse_json(group.attrs.get("facts", "{}"))
    return {name: value for name, value in simulated.items() if value} | facts


def _texts(group: Any, episode: StoredEpisode) -> dict[str, Fact]:
    """The texts that describe an episode: attributes of its group, and arrays.

    Arrays hold one text, a text for each row, or one for each of several episodes in a row. They
    lie beside the numbers or in a group there, such as ``obs``, or in one that describes episodes.
    """
    values = {name: [value] for name, value in group.attrs.items()}
    try:  # of LIBERO, where it is the same for all
        problem = parse_json(group.parent.attrs["problem_info"])
        values["language_instruction"] = [problem["language_instruction"]]
    except (KeyError, TypeError, ValueError):
        pass
    several = episode.number is not None
    around = (group.parent, group.file) if several else ()
    for place in (group, *(place[n] for place in around for n in INDEX if n in place)):
        for name, item in _strings(place):
            if item.ndim == 0:
                values.setdefault(name, [values_of(item)])
            elif len(item) == 1 and not several:
                values.setdefault(name, [*values_of(item)])
            elif several and len(item) == episode.count:
                values.setdefault(name, [values_of(item)[episode.number]])
            elif place is group and len(item) >= (episode.stop or 0):
                values.setdefault(name, [*values_of(item, slice(episode.start, episode.stop))])
    return text_facts(values)


def _strings(group: Any) -> Iterator[tuple[str, Any]]:
    """The arrays of texts in a group and in those directly below it, by their names."""
    if not isinstance(group, h5py.Group):
        return
    below = [item for item in group.values() if isinstance(item, h5py.Group)]
    for place in (group, *below):
        for name, item in place.items():
            if isinstance(item, h5py.Dataset) and item.ndim < 2:
                is_text = h5py.check_string_dtype(item.dtype) is not None
                if is_text and item.dtype.itemsize <= 4 * LONGEST:  # pictures may be strings, too
                    yield name, item


def shared_file(path: Path, within: Path | None) -> Any:
    """An HDF5 file, which stays open while its episodes are read; as `open_hdf5`."""
    return _file(path, within, file_stamp(path))


@functools.lru_cache(maxsize=2)
def _file(path: Path, within: Path | None, _: str) -> Any:
    return open_hdf5(path, within)
