"""Check YAML values against a parameter's type, strictly: a string never becomes a number."""

from __future__ import annotations

import difflib
import functools
import json
import re
from collections.abc import Sequence
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Lt

from acwm_core.errors import RecipeError

NonNegativeInt = Annotated[int, Ge(0)]
PositiveInt = Annotated[int, Ge(1)]
Fraction = Annotated[float, Ge(0), Le(1)]
FractionBelowOne = Annotated[float, Ge(0), Lt(1)]

_BOUNDS = {Ge: "at least", Gt: "above", Le: "at most", Lt: "below"}


def checked(where: str, value: Any, expected: Any) -> Any:
    """Check a value and convert it to the type `expected` (a list to a tuple, an int to a float).

    Types that pydantic does not know cannot be checked and accept any value.

    Args:
        where: the parameter, e.g. ``"model.layers"``, for the message.
        expected: a type, whose ranges are those of ``Annotated[int, Ge(1)]``.

    Raises:
        RecipeError: the value has another type, or is out of range.
    """
    import pydantic  # 60 ms, and only if a recipe sets something

    try:
        adapter = _adapter(expected)
    except pydantic.errors.PydanticUserError:
        return value
    try:
        return adapter.validate_json(json.dumps(value), strict=True)
    except pydantic.ValidationError as error:
        context = error.errors(include_url=False)[0].get("ctx", {})
        for kind, words in _BOUNDS.items():
            if (limit := context.get(kind.__name__.lower())) is not None:
                raise RecipeError(f"{where}={show(value)} must be {words} {limit:g}") from None
        wanted = describe(expected)
        near = difflib.get_close_matches(str(value), re.findall("'(.+?)'", wanted), 1, cutoff=0.5)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise RecipeError(f"{where}={show(value)}: expected {wanted}{hint}") from None
    except (TypeError, ValueError):  # it is not of JSON types
        raise RecipeError(f"{where}={value}: expected {describe(expected)}") from None


def _adapter(expected: Any) -> Any:
    try:
        return _kept_adapter(expected)
    except TypeError:  # `Annotated` by something without a hash
        return _kept_adapter.__wrapped__(expected)


@functools.lru_cache(maxsize=1024)
def _kept_adapter(expected: Any) -> Any:
    """What checks a type; to make it takes longer than to check a hundred values."""
    import pydantic

    return pydantic.TypeAdapter[Any](expected)


def show(value: Any) -> str:
    """Format a value as it would be written in an override."""
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False, default=str)


def describe(expected: Any) -> str:
    """Describe a type: ``int or null``, ``'velocity' or 'clean'``, ``[str, …]`` for a list.

    A range follows its type: ``int at least 1``.
    """
    origin, arguments = get_origin(expected), get_args(expected)
    if origin is Annotated:
        return _with_range(arguments[0], arguments[1:])
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
    if origin in (list, tuple):  # as written in YAML
        return f"[{', '.join(inner)}]"
    return f"{name}[{', '.join(inner)}]" if inner else name


def _with_range(base: Any, metadata: Sequence[Any]) -> str:
    limits = [
        f"{words} {getattr(limit, kind.__name__.lower()):g}"
        for limit in metadata
        for kind, words in _BOUNDS.items()
        if isinstance(limit, kind)
    ]
    return " ".join([describe(base), *limits[:1], *(f"and {limit}" for limit in limits[1:])])
