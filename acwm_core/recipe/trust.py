"""Code that a recipe names: it is run only if a person typed its name, or trusts the recipe.

The rule is asked of the composed recipe, wherever its parts came from: a name that was not typed on
the command line or in Python is never imported.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from acwm_core.errors import RecipeError, noting
from acwm_core.recipe.compose import parse_override, with_overrides

NAMES_OF_CODE = ("class_path", "metric_class", "function", "detector")
"""Parameters whose value is imported, or is a file that is a program."""

FOLDER = "default_root_dir"
"""The flag of the trainer that names a folder, which training writes to."""

_IMPORTED = re.compile(r"[^\W\d]\w*(\.\w+)*:[^\W\d]\w*(\.\w+)*")
"""What `import_named` takes, ``module:name``."""

_PLAIN = re.compile(r"[\w:,+ -]*|-?\d+\.\d*")
"""Text of the section `trainer` that is no name of code: Lightning parses any other as YAML."""

_OVERRIDE = re.compile(r"[\w.]+=")

_is_said = False


def trust_recipes(said: bool) -> None:
    """Trust the authors of all recipes in this process, as ``--trust-recipe`` asks."""
    global _is_said
    _is_said = said


def recipes_are_trusted() -> bool:
    """Whether the command line said ``--trust-recipe``."""
    return _is_said


def refuse_code(
    recipe: Mapping[str, Any],
    overrides: Sequence[str] = (),
    sections: Iterable[str] | None = None,
    origin: object = "the recipe",
) -> None:
    """Refuse code that a composed recipe names, unless an override names the same in its place.

    Args:
        recipe: the sections of the recipe, with the overrides applied.
        overrides: what the person typed. An overlay such as ``+small`` is a file.
        sections: the sections that will be used; all by default.
        origin: the recipe's file, for the message.

    Raises:
        RecipeError: it names code; says where, and how to allow it.
    """
    typed = with_overrides({}, [override for override in overrides if not override.startswith("+")])
    known = dict(_code(typed))
    used = {name: recipe[name] for name in recipe if sections is None or name in {*sections}}
    for place, value in _code(used):
        if place not in known or known[place] != value:
            is_folder = place.endswith(FOLDER)
            what = "a folder to write to" if is_folder else "code that would be executed"
            raise RecipeError(
                f"{place}={value!s:.80} in {origin} names {what}: check it, and add "
                "--trust-recipe if you trust its author"
            )


def _code(values: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """The values that name code, by their place, e.g. ``evaluation.metrics[0].metric_class``."""
    name = place.rpartition(".")[2].partition("[")[0]
    in_trainer = place.startswith("trainer.")
    if isinstance(values, Mapping):
        if in_trainer and name != "max_time":  # the class and arguments of an object
            yield place, values
        for key, value in cast(Mapping[Any, Any], values).items():
            yield from _code(value, f"{place}.{key}" if place else str(key))
    elif isinstance(values, (list, tuple)):
        for number, value in enumerate(cast(Sequence[Any], values)):
            yield from _code(value, f"{place}[{number}]")
    elif isinstance(values, str):
        if _OVERRIDE.match(values):  # in an experiment's file
            yield from _code(parse_override(values))
        elif (
            name in (*NAMES_OF_CODE, FOLDER)
            or _IMPORTED.fullmatch(values)
            or (in_trainer and not _PLAIN.fullmatch(values))
        ):
            yield place, values


def import_named(name: str, asked: str) -> Any:
    """Import what a person typed as ``module:name``, also from the working directory.

    Args:
        name: the name.
        asked: what asks for it, for the message, e.g. ``"cost.function=mine:cost"``.

    Raises:
        RecipeError: it is not written as ``module:name``, or there is no such module or name.
    """
    if not _IMPORTED.fullmatch(name):
        raise RecipeError(f"{asked} cannot be imported: write it as module:name")
    module, _, attribute = name.partition(":")
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        with noting(f"in {asked}", module):
            return getattr(importlib.import_module(module), attribute)
    except (ModuleNotFoundError, AttributeError) as error:
        raise RecipeError(f"{asked} cannot be imported: {error}") from error
    finally:
        sys.path.remove(here)
