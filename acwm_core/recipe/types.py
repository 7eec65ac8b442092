"""Values from YAML against a parameter's type, strictly: no text becomes a number."""

from __future__ import annotations

import difflib
import json
import re
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from acwm_core.errors import RecipeError


def checked(where: str, value: Any, expected: Any) -> Any:
    """The value as the type asks for it (a list becomes a tuple, an int a float).

    Types that nothing is known about, and so cannot be checked, take any value.

    Args:
        where: the parameter, e.g. ``"model.layers"``, for the message.

    Raises:
        RecipeError: the value is of another type.
    """
    import pydantic  # 60 ms, and only if a recipe sets something

    try:
        adapter = pydantic.TypeAdapter[Any](expected)
    except pydantic.errors.PydanticUserError:
        return value
    try:
        return adapter.validate_json(json.dumps(value), strict=True)
    except pydantic.ValidationError:
        wanted = describe(expected)
        near = difflib.get_close_matches(str(value), re.findall("'(.+?)'", wanted), 1, cutoff=0.5)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise RecipeError(f"{where}={show(value)}: expected {wanted}{hint}") from None
    except (TypeError, ValueError):  # not of JSON types
        raise RecipeError(f"{where}={value}: expected {describe(expected)}") from None


def show(value: Any) -> str:
    """A value as one would write it in an override."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)


def describe(expected: Any) -> str:
    """A type in words: ``int or null``, ``'velocity' or 'clean'``, ``[str, …]`` for a list."""
    origin, arguments = get_origin(expected), get_args(expected)
    if origin is Literal:
        return " or ".join(map(repr, arguments))
    if origin in (Union, UnionType):
        return " or ".join(map(describe, arguments))
    if expected in (None, NoneType):
        return "null"
    name = getattr(origin or expected, "__name__", str(expected))
    inner = ["…" if argument is ... else describe(argument) for argument in arguments]
    if origin is list:
        inner.append("…")
    if origin in (list, tuple):  # as one writes them in YAML
        return f"[{', '.join(inner)}]"
    return f"{name}[{', '.join(inner)}]" if inner else name
