"""HDF5 of robomimic, LIBERO, ACT/ALOHA, stable-worldmodel, acwm, and any other layout."""

from __future__ import annotations

import importlib
import json
import math
import os
import re
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from acwm_core.arrays import check_unpacked
from acwm_core.errors import DataError
from acwm_core.files import check_fetched
from acwm_formats.array_store import ArrayLayout
from acwm_formats.episode_bounds import INDEX, Bounds, bounds_of, check_agreement, may_tell, tells
from acwm_formats.frames import MOST_FRAMES
from acwm_formats.hdf5_chunks import check_chunks
from acwm_formats.hdf5_links import check_references, external_links, open_plain
from acwm_formats.images import CHANNELS, MOST_BYTES, stacked
from acwm_formats.names import natural
from acwm_formats.robosuite import robosuite
from acwm_formats.sources import files_in

h5o: Any = importlib.import_module("h5py.h5o")  # h5py does not say that it has it

ENDINGS = (".hdf5", ".h5")
ALOHA_RATE = Fraction(50)  # the layout does not say it; all of its recorders have a step of 20 ms


def files_of(path: Path) -> list[Path]:
    """The HDF5 files that `path` is or holds, in natural order."""
    if path.is_file():
        check_fetched(path)
        return [path] if h5py.is_hdf5(path) else []
    if not path.is_dir():
        return []
    return files_in(path, ENDINGS)


def open_hdf5(path: Path, within: Path | None) -> Any:
    """Open an HDF5 file.

    Args:
        path: the file.
        within: the folder, or the only file, that its references may not lead out of; None allows
            any file, see `check_references`.

    Raises:
        DataError: it is missing or damaged, or refers to other files.
    """
    file = open_plain(path)
    try:
        check_references(file, within)
    except BaseException:
        file.close()
        raise
    return file


def array(group: Any, name: str) -> Any:
    """The dataset `name` of a group.

    Raises:
        DataError: there is none, or it claims more than is read.
    """
    dataset = group.get(name)
    if not isinstance(dataset, h5py.Dataset):
        raise DataError(f"{group.file.filename} has no array {group.name.rstrip('/')}/{name}")
    row = math.prod(dataset.shape[1:]) * dataset.dtype.itemsize
    if row > MOST_BYTES or dataset.shape[:1] > (MOST_FRAMES,):
        where = f"{dataset.name} in {group.file.filename}"
        raise DataError(f"{where} claims to be {list(dataset.shape)}, which is more than is read")
    return dataset


def values_of(dataset: Any, rows: slice | tuple[()] = ()) -> Any:
    """What a dataset holds, or some of its rows.

    Raises:
        ValueError: it claims far more than the file stores, or unpacks to more than it claims.
    """
    stored = 0 if dataset.external else dataset.id.get_storage_size()  # which claims its own size
    check_unpacked(stored, dataset.size * dataset.dtype.itemsize)
    if dataset.ndim:
        check_chunks(dataset, rows or slice(None))
    return dataset[rows]


def episode_groups(file: Any, layout: ArrayLayout) -> list[str]:
    """The groups that hold what the layout names, in natural order."""
    names = [
        name
        for name in _groups(file)
        if layout.actions in (group := file[name])
        and all(path in group for path in layout.cameras.values())
    ]
    return sorted(names, key=natural)


def partial_groups(file: Any, layout: ArrayLayout) -> list[str]:
    """The groups that hold a part of what the layout names, and so are no episode."""
    if layout.is_robosuite:
        wanted = [name for name in _groups(file) if re.fullmatch(r"data/[^/]+", name)]
    else:
        paths = (layout.actions, *layout.cameras.values())
        wanted = [n for n in _groups(file) if n != "/" and any(path in file[n] for path in paths)]
    whole = episode_groups(file, layout)
    return sorted({*wanted} - {*whole}, key=natural)


def _groups(file: Any) -> Iterator[str]:
    """The groups of a file, and of others that it links to, each once."""
    known: set[tuple[str, int]] = set()
    waiting = [""]
    while waiting:
        name = waiting.pop(0)
        group = file[name or "/"]
        for inner, item in _below(group):
            if identity(item) not in known:
                known.add(identity(item))
                yield f"{name}/{inner}".strip("/") or "/"
        for inner, _ in external_links(group):
            where = f"{name}/{inner}".strip("/")
            if _is_group(item := file.get(where)) and identity(item) not in known:
                waiting.append(where)


def _below(group: Any) -> list[tuple[str, Any]]:
    """A group and those below it in the same file, by their names in it."""
    groups = [("", group)]
    group.visititems(lambda name, item: groups.append((name, item)) if _is_group(item) else None)
    return groups


def identity(item: Any) -> tuple[str, int]:
    """What tells a group or dataset from all others: its file, and its place there."""
    return os.path.realpath(item.file.filename), h5o.get_info(item.id).addr


def layout_of(file: Any) -> ArrayLayout | None:
    """The layout of a file, if it is one that is known."""
    if file.attrs.get("format") == "acwm":
        return _acwm_layout(file)
    data = file.get("data")
    if isinstance(data, h5py.Group) and len(data) and (layout := _robomimic_layout(data)):
        return layout
    if "action" in file and "observations/images" in file:
        return _aloha_layout(file)
    places = (place for place in (file, data) if isinstance(place, h5py.Group))
    return next((layout for place in places if (layout := _concatenated_layout(place))), None)


def _acwm_layout(file: Any) -> ArrayLayout | None:
    names = sorted(name for name in file if name.startswith("episode_"))
    if not names:
        return None
    states = {name: f"states/{name}" for name in file[names[0]].get("states", ())}
    rate = Fraction(json.loads(file.attrs["card"])["environment"]["fps"]).limit_denominator(10**6)
    return ArrayLayout("acwm", {"video": "video"}, "actions", states, rate)


def _robomimic_layout(data: Any) -> ArrayLayout | None:
    first: Any = data[sorted(data, key=natural)[0]]
    if not _is_group(first) or "obs" not in first or "actions" not in first:
        return None
    seen, length = first["obs"], len(first["actions"])
    for name in seen:
        if isinstance(seen[name], h5py.Dataset) and seen[name].ndim == 5:
            raise DataError(
                stacked(f"{seen[name].name} in {data.file.filename}", seen[name].shape[1:])
            )
    cameras = {name: f"obs/{name}" for name in seen if is_video(seen[name])}
    states = {name: f"obs/{name}" for name in seen if is_numbers(seen[name], length)}
    libero = "bddl_file_name" in data.attrs or "problem_info" in data.attrs
    name = "LIBERO" if libero else "robomimic"
    control = robosuite(data.attrs.get("env_args"))
    rows = first["actions"]
    gripper = rows.ndim == 2 and rows.shape[1] == control.arm + 1 > 1
    held = (control.arm,) if gripper else ()
    return ArrayLayout(name, cameras, "actions", states, control.rate, control.kind, held=held)


def _is_group(item: Any) -> bool:
    return isinstance(item, h5py.Group)


def _aloha_layout(file: Any) -> ArrayLayout:
    images, length = file["observations/images"], len(file["action"])
    cameras = {name: f"observations/images/{name}" for name in images}
    seen = file["observations"]
    states = {name: f"observations/{name}" for name in seen if is_numbers(seen[name], length)}
    note = "50 frames per second, which ALOHA's recorders have and its files do not say."
    return ArrayLayout("ALOHA", cameras, "action", states, ALOHA_RATE, "absolute", note)


def _concatenated_layout(group: Any) -> ArrayLayout | None:
    """Arrays of all episodes in a row, with others that say where each begins or ends."""
    actions = next((name for name in ("action", "actions") if name in group), "")
    if not actions or not isinstance(group[actions], h5py.Dataset):
        return None
    length = len(group[actions])
    cameras = {name: name for name in group if is_video(group[name])}
    if not cameras or not bounds_in(group, length):
        return None
    states = {n: n for n in group if is_numbers(group[n], length) and not is_bound(n, actions)}
    ours = {"ep_len", "ep_offset"} <= {*group}
    name = "stable-worldmodel" if ours else "arrays of all episodes"
    return ArrayLayout(name, cameras, actions, states)


def is_bound(name: str, actions: str) -> bool:
    """Whether an array is the actions or says where episodes are, and so is no state."""
    return name == actions or tells(name)


def bounds_in(group: Any, count: int, *, alone: bool = True) -> Bounds | None:
    """The episodes in the rows of a group; None if they are one.

    What says it may lie beside the arrays, in a group ``meta`` there, or, if the group is the only
    one, in any group there, and in those above it; attributes of groups may say it, too.

    Args:
        group: the group.
        count: number of rows of its actions.
        alone: whether no other group of the file holds episodes.

    Raises:
        DataError: arrays contradict each other.
    """
    bounds: Bounds | None = None
    for place in (group, group.parent, group.file) if alone else (group,):
        parts = {"": place} | {name: place.get(name) for name in (place if alone else INDEX)}
        for prefix, part in parts.items():
            if not _is_group(part):
                continue
            arrays = {
                _qualified(prefix, name): values_of(item)
                for name, item in part.items()
                if isinstance(item, h5py.Dataset)
                and item.ndim in (1, 2)
                and may_tell(_qualified(prefix, name), item, count)
            }
            arrays |= {
                name: values
                for name, value in part.attrs.items()
                if (values := np.asarray(value)).ndim in (1, 2) and may_tell(name, values, count)
            }
            where = f"{group.file.filename} ({', '.join(arrays)})"
            if bounds:
                check_agreement(arrays, bounds, count, where, flags=alone)
            elif arrays:
                bounds = bounds_of(arrays, count, where, flags=alone)
    return bounds


def _qualified(group: str, name: str) -> str:
    """A name such as ``from`` in a group of facts about episodes is that of an episode."""
    return name if group not in INDEX or tells(name) else f"episode_{name}"


def is_video(item: Any) -> bool:
    """Whether a dataset holds images: ``[T, H, W, C]``, ``[T, C, H, W]`` or depth ``[T, H, W]``."""
    if not isinstance(item, h5py.Dataset) or item.dtype.kind not in "uif":
        return False
    shape = item.shape
    colours = len(shape) == 4 and (shape[3] in CHANNELS or shape[1] in CHANNELS)
    return colours and min(sorted(shape[1:])[1:]) >= 8


def is_numbers(item: Any, length: int) -> bool:
    """Whether a dataset is a state: numbers with a row per frame, and no images."""
    return (
        isinstance(item, h5py.Dataset)
        and item.dtype.kind in "fiub"
        and item.ndim in (1, 2)
        and len(item) in (length, length + 1)
    )
