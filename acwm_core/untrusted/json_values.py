"""Read JSON safely: bounded, with plain numbers and text, and checked against a dataclass."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any, TypeVar, cast

from acwm_core.errors import DataError
from acwm_core.untrusted.files import STEERING, printable, read_bytes

MAX_INT = 2**64

T = TypeVar("T")


def parse_json(data: bytes | str) -> Any:
    """Parse JSON with finite numbers and plain text.

    Raises:
        ValueError: it is something else, or nested more than 200 levels deep.
    """
    found = _validated(data, Any)
    _check_plain(found)
    return found


def read_json(path: Path, kind: type[T], what: str) -> T:
    """Read a JSON file as a dataclass; entries that the dataclass does not have are left out.

    Args:
        path: the file.
        kind: a dataclass.
        what: what the file should be, for the message, e.g. ``"a summary"``.

    Raises:
        DataError: it is damaged, or of another version of acwm.
        OSError: it does not exist or cannot be read.
    """
    try:
        return typed(parse_json(read_bytes(path)), kind)
    except ValueError as error:
        why = f"{printable(str(path))} is not {what} of this version of acwm ({error})"
        raise DataError(why) from None


def typed(values: Any, kind: type[T]) -> T:
    """Convert values of JSON types to `kind`, checked strictly: a string never becomes a number.

    Raises:
        ValueError: a value has the wrong type; the one-line message says which.
    """
    return _validated(json.dumps(values), kind)


def _validated(data: bytes | str, kind: Any) -> Any:
    from pydantic import ValidationError

    try:
        return _adapter(kind).validate_json(data, strict=True)
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
        if STEERING.search(value):
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
        raise ValueError("it has numbers that are infinite or too large")
