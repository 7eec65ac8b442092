"""The arrays and facts of an episode in an HDF5 file, which stays open while it is read."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from acwm_core.errors import DataError
from acwm_core.files import parse_json
from acwm_formats.array_store import ArrayStore
from acwm_formats.frames import file_stamp
from acwm_formats.hdf5_layouts import array, open_hdf5, values_of
from acwm_formats.labels import Labels

LONGEST = 1000  # characters of a text that is kept


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
        image = self.group[name][index]
        if isinstance(image, bytes):
            return image
        return image.tobytes() if image.ndim == 1 and image.dtype == np.uint8 else image

    def description(self) -> tuple[dict[str, Any], Labels | None]:
        """As in `ArrayStore`."""
        group = self.group
        if group.file.attrs.get("format") != "acwm":
            return texts(group), None
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


def texts(group: Any) -> dict[str, str]:
    """The texts that describe an episode: attributes of its group, and arrays of one text.

    Long ones, such as the source of a simulator's model, are left out.
    """
    texts: dict[str, str] = {}
    items = [*group.attrs.items()] + [
        (name, values_of(item) if item.ndim == 0 else values_of(item)[0])
        for name, item in group.items()
        if isinstance(item, h5py.Dataset) and item.dtype.kind in "SO" and item.size == 1
    ]
    try:  # of LIBERO, where it is the same for all
        problem = parse_json(group.parent.attrs["problem_info"])
        items.append(("language_instruction", problem["language_instruction"]))
    except (KeyError, TypeError, ValueError):
        pass
    for name, value in items:
        text = value.decode("utf-8", "replace") if isinstance(value, bytes) else value
        if isinstance(text, str) and 0 < len(text) <= LONGEST:
            texts[name] = text
    return texts


def shared_file(path: Path, within: Path | None) -> Any:
    """An HDF5 file, which stays open while its episodes are read; as `open_hdf5`."""
    return _file(path, within, file_stamp(path))


@functools.lru_cache(maxsize=2)
def _file(path: Path, within: Path | None, _: str) -> Any:
    return open_hdf5(path, within)
