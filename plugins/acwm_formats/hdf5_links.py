"""What an HDF5 file refers to in other files: external links and storage, virtual datasets."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import h5py

from acwm_core.errors import DataError
from acwm_core.files import check_fetched, check_regular

h5o: Any = importlib.import_module("h5py.h5o")  # h5py does not say that it has it

ADVICE = "give --follow-links to read it"

_NUMBERED = re.compile(r"%\d*b")
"""What stands in the name of a virtual dataset's source for the number of a block."""


class Reference(NamedTuple):
    """Another file that an HDF5 file refers to.

    Attributes:
        name: the link or the array that refers to it.
        path: where the library looks for it.
        array: the array of another HDF5 file that is shown; empty for a link.
        size: bytes that are taken of it, if it is no HDF5 file.
    """

    name: str
    path: Path
    array: str = ""
    size: int | None = None


def check_references(file: Any, within: Path | None) -> None:
    """Refuse an HDF5 file that refers, by itself or through others, to files that are elsewhere.

    Args:
        file: the opened file.
        within: the folder, or the only file, that references may not lead out of. None: they may
            lead to any file.

    Raises:
        DataError: a reference leads out, or to what is missing or no regular file; names it.
    """
    limit = None if within is None else os.path.realpath(within)
    known = set[tuple[str, str]]()
    walked = {os.path.realpath(file.filename)}
    waiting = _others(file, within, limit, known)
    while waiting:
        path, array = waiting.pop()
        with open_plain(Path(path)) as other:
            if array and array not in other:
                raise DataError(f"{path} has no array {array}, which {file.filename} shows")
            if path not in walked:
                walked.add(path)
                waiting += _others(other, within, limit, known)


def open_plain(path: Path) -> Any:
    """Open an HDF5 file, whatever it refers to.

    Raises:
        DataError: it is missing or damaged.
    """
    check_fetched(path)
    try:
        return h5py.File(path, "r")
    except (OSError, RuntimeError) as error:
        raise DataError(f"{path} cannot be read as HDF5 ({error})") from error


def external_links(group: Any) -> list[tuple[str, Any]]:
    """The links of a group, and of those below it, that lead to other HDF5 files, by name."""
    links: list[tuple[str, Any]] = []

    def look(name: str, link: Any) -> None:
        if isinstance(link, h5py.ExternalLink):
            links.append((name, link))

    group.visititems_links(look)
    return links


def _others(
    file: Any, within: Path | None, limit: str | None, known: set[tuple[str, str]]
) -> list[tuple[str, str]]:
    """The HDF5 files, and arrays in them, that a file refers to and that are not yet known."""
    references: list[tuple[str, str]] = []
    for reference in _references(file):
        path = os.path.realpath(reference.path)
        if reference.size is None and (path, reference.array) in known:
            continue
        who = f"{file.filename} refers by {reference.name} to {reference.path}"
        if limit is not None and not Path(path).is_relative_to(limit):
            raise DataError(f"{who}, which is not in {within}: {ADVICE}")
        try:
            check_regular(Path(path))
            there = Path(path).stat().st_size
        except OSError as error:
            raise DataError(f"{who}, which cannot be read ({error.strerror})") from None
        if reference.size is None:
            known.add((path, reference.array))
            references.append((path, reference.array))
        elif there < reference.size:
            raise DataError(f"{who}, which has {there:,} bytes, not {reference.size:,}")
    return references


def _references(file: Any) -> Iterator[Reference]:
    beside = Path(file.filename).parent
    for name, link in external_links(file):
        yield Reference(name, beside / link.filename)
    for array in _arrays(file):
        opened = h5py.h5d.open(file.id, array)
        described, name = opened.get_create_plist(), array.decode("utf-8", "replace")
        rest = opened.get_storage_size() if described.get_external_count() else 0
        for number in range(described.get_external_count()):
            stored, offset, size = described.get_external(number)
            taken = min(rest, size)  # of the last, any size may be claimed
            yield Reference(name, Path(os.fsdecode(stored)).absolute(), size=offset + taken)
            rest -= taken
        if described.get_layout() == h5py.h5d.VIRTUAL:
            for source, target in _sources(described):
                if _NUMBERED.search(source):
                    raise DataError(
                        f"{file.filename} shows in {name} a numbered series of files, {source}: "
                        "copy their data into it"
                    )
                path = Path(file.filename) if source == "." else beside / source
                yield Reference(name, path, target)


def _sources(described: Any) -> list[tuple[str, str]]:
    """File and array of each source of a virtual dataset."""
    count = described.get_virtual_count()
    pairs = (
        (described.get_virtual_filename(n), described.get_virtual_dsetname(n)) for n in range(count)
    )
    return sorted({*pairs})


def _arrays(file: Any) -> list[bytes]:
    """The names of all datasets of a file."""
    names: list[bytes] = []

    def look(name: bytes, info: Any) -> None:
        if info.type == h5o.TYPE_DATASET:
            names.append(name)

    h5o.visit(file.id, look, info=True)
    return names
