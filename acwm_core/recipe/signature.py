"""The parameters that a class or function takes, with those it passes on to its base classes."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from typing import Any, NamedTuple, get_type_hints

REQUIRED = inspect.Parameter.empty
"""The default of a parameter that has none."""


class Parameter(NamedTuple):
    """A parameter's type, `Any` if unknown, and its default."""

    type: Any
    default: Any


class Signature(NamedTuple):
    """The parameters of a class or function that can be given by name."""

    owner: str  # the name of the class or function
    parameters: Mapping[str, Parameter]
    open: bool = False  # whether it also takes parameters of other names


def signature(target: Callable[..., Any]) -> Signature:
    """The parameters of a class or function.

    A constructor with ``**kwargs`` passes them on to the next base class that has a constructor.
    """
    name = getattr(target, "__name__", type(target).__name__)
    if not isinstance(target, type):
        return Signature(name, *_named(target, inspect.signature(target)))
    inherited: dict[str, Parameter] = {}
    passes_on = False
    for base in target.__mro__:
        constructor: Any = vars(base).get("__init__")
        if constructor is None or base.__module__ in ("builtins", "torch.nn.modules.module"):
            continue  # `object` and `Module` take nothing that a recipe could set
        parameters = [*inspect.signature(constructor).parameters.values()][1:]  # without self
        typed = base if is_dataclass(base) else constructor
        own, passes_on = _named(typed, inspect.Signature(parameters))
        inherited = {**own, **inherited}
        if not passes_on:
            break
    return Signature(name, inherited, passes_on)


def _named(typed: Any, taken: inspect.Signature) -> tuple[dict[str, Parameter], bool]:
    """The parameters that have a name, with the types of `typed`; and whether there may be more."""
    try:
        types = get_type_hints(typed, include_extras=True)
    except Exception:  # it names what only type checkers import
        types = dict[str, Any]()
    parameters = taken.parameters.values()
    named = {
        parameter.name: Parameter(types.get(parameter.name, Any), parameter.default)
        for parameter in parameters
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    }
    return named, any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
