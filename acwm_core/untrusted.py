"""Reading what a stranger may have made: bounded in memory and time, within its folder, inert.

Everything that acwm reads of datasets, runs, results and recipes comes through here: `read_bytes`
takes plain files only, `parse_json` and `PlainLoader` bound size, depth and numbers and refuse text
that would steer a terminal, and `check_folder` refuses links that lead out of a folder.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import re
import stat
from pathlib import Path
from typing import Any, TypeVar, cast

import yaml

from acwm_core.errors import DataError

MEGABYTE = 2**20
MAX_JSON = 64 * MEGABYTE
"""Bytes of a JSON file; the largest of ours, summaries with curves, have a few millions."""

MAX_YAML = MEGABYTE
"""Bytes of a YAML file: a second or ten of PyYAML. Ours have some thousands."""

MAX_VALUES, MAX_DEPTH = 20_000, 50
"""Values of a YAML file with all its aliases written out, and how deep they may lie."""

MAX_INT = 2**64

MAX_DIGITS = 400
"""Characters of a number in YAML."""

_STEERING = re.compile(
    r"[\0-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\u202a-\u202e\u2066-\u2069]"
)
"""Characters that control a terminal or the direction of text, or are none by themselves."""

_TAGS = ("null", "bool", "int", "float", "str", "seq", "map", "merge")
_PLAIN_TAGS = {f"tag:yaml.org,2002:{name}" for name in _TAGS}
"""What recipes and cards are made of; neither has dates, sets or bytes."""

T = TypeVar("T")


def printable(text: str) -> str:
    """The text with `?` for what would steer a terminal."""
    return _STEERING.sub("?", text)


def read_bytes(path: Path, at_most: int = MAX_JSON) -> bytes:
    """The bytes of a plain file.

    Raises:
        DataError: it is a device, a pipe or a folder, or larger than `at_most` bytes.
        OSError: it is not there, or cannot be read.
    """
    # Not to wait for the other end of a pipe.
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise DataError(f"{printable(str(path))} is no plain file: remove it")
        data = file.read(at_most + 1)
    if len(data) > at_most:
        raise DataError(f"{printable(str(path))} has more than the {at_most} bytes it may have")
    return data


def parse_json(data: bytes | str) -> Any:
    """JSON whose numbers are finite and whose text is plain.

    Raises:
        ValueError: it is something else, or deeper than 200 values in one another.
    """
    from pydantic_core import from_json

    found = from_json(data, allow_inf_nan=False)
    _check_plain(found)
    return found


def read_json(path: Path, kind: type[T], what: str) -> T:
    """A JSON file as a dataclass; entries that it does not know are left out.

    Args:
        path: the file.
        kind: a dataclass.
        what: it should be, for the message, e.g. ``"a summary"``.

    Raises:
        DataError: it is damaged, or of another version of acwm.
        OSError: it is not there, or cannot be read.
    """
    try:
        return typed(parse_json(read_bytes(path)), kind)
    except ValueError as error:
        why = f"{printable(str(path))} is not {what} of this version of acwm ({error})"
        raise DataError(why) from None


def typed(values: Any, kind: type[T]) -> T:
    """Values of JSON types as a dataclass, all checked strictly: no text becomes a number.

    Raises:
        ValueError: says which value is wrong, in one line.
    """
    from pydantic import ValidationError

    try:
        return _adapter(kind).validate_json(json.dumps(values), strict=True)
    except ValidationError as error:
        reason = error.errors()[0]
        where = printable(".".join(map(str, reason["loc"])))[:200]
        said = reason["msg"].splitlines()[0].removeprefix("Value error, ")[:200]
        raise ValueError(f"{where}: {said}" if where else said) from None


@functools.cache
def _adapter(kind: Any) -> Any:
    from pydantic import TypeAdapter

    return TypeAdapter[Any](kind)


def _check_plain(value: Any) -> None:
    if isinstance(value, str):
        if _STEERING.search(value):
            raise ValueError(f"it has control characters in {printable(value)[:80]!r}")
    elif isinstance(value, dict):
        for key, each in cast(dict[str, Any], value).items():
            _check_plain(key)
            _check_plain(each)
    elif isinstance(value, list):
        for each in cast(list[Any], value):
            _check_plain(each)
    elif isinstance(value, int) and not -MAX_INT <= value < MAX_INT:
        raise ValueError("it has whole numbers of more than 64 bits")
    elif isinstance(value, float) and not abs(value) < 1e300:
        raise ValueError("it has numbers without end")


class PlainLoader(yaml.SafeLoader):
    """YAML of bounded size and depth, however its aliases multiply it.

    Raises:
        yaml.YAMLError: it is beyond the bounds, or no YAML.
    """

    def __init__(self, stream: str) -> None:
        if len(stream) > MAX_YAML:
            raise yaml.YAMLError(f"it has more than {MAX_YAML} characters")
        self._depth = self._count = 0
        self._sizes: dict[int, int] = {}  # of nodes with all that is in them
        super().__init__(stream)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """One value; an alias counts as much as what it stands for."""
        if self._depth == MAX_DEPTH:
            raise yaml.YAMLError(f"it has more than {MAX_DEPTH} values in one another")
        alias = self.check_event(yaml.AliasEvent)  # pyright: ignore[reportUnknownMemberType]
        before, self._depth = self._count, self._depth + 1
        node: Any = super().compose_node(parent, index)
        self._depth -= 1
        if alias and id(node) not in self._sizes:
            raise yaml.YAMLError("a value holds itself")
        self._count += self._sizes[id(node)] if alias else 1
        self._sizes[id(node)] = self._count - before
        if self._count > MAX_VALUES:
            raise yaml.YAMLError(f"it stands for more than {MAX_VALUES} values")
        if node.tag not in _PLAIN_TAGS:
            raise yaml.YAMLError(f"it has a {printable(node.tag)[:80]!r}")
        if isinstance(node, yaml.ScalarNode):
            if _STEERING.search(node.value):
                raise yaml.YAMLError("it has control characters")
            if len(node.value) > MAX_DIGITS and node.tag.endswith((":int", ":float")):
                raise yaml.YAMLError(f"it has a number of {len(node.value)} characters")
        return node

    def get_single_data(self) -> Any:
        """All that the text says; whatever the parser raises of it is a `YAMLError`."""
        try:
            return super().get_single_data()
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise yaml.YAMLError(f"{type(error).__name__}: {error}") from error


def check_folder(folder: Path) -> None:
    """Refuse a folder that holds, at any depth, a link that leads out of it or a special file.

    To be asked of every dataset and run before anything in it is read or written.

    Raises:
        DataError: names it.
    """
    home, folders = os.path.realpath(folder), [str(folder)]
    while folders:
        with (
            contextlib.suppress(FileNotFoundError, NotADirectoryError),
            os.scandir(folders.pop()) as entries,
        ):
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.path)
                elif entry.is_symlink():
                    target = os.path.realpath(entry.path)
                    if os.path.commonpath([home, target]) != home:
                        raise DataError(
                            f"{printable(entry.path)} is a link that leads out of {folder}, which "
                            "none may: put what it leads to in its place, or remove it"
                        )
                elif not entry.is_file(follow_symlinks=False):
                    raise DataError(f"{printable(entry.path)} is no plain file: remove it")
