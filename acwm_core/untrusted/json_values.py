"""JSON: bounded, of plain numbers and text, and as the dataclass that it should be."""

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
    """JSON whose numbers are finite and whose text is plain.

    Raises:
        ValueError: it is something else, or deeper than 200 values in one another.
    """
    found = _validated(data, Any)
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
        raise ValueError("it has numbers without end")
