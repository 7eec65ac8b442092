"""Errors for users: one clear sentence that says what to do next, and notes of where it arose.

For every `AcwmError`, the command line prints only the message and exits with code 2, and likewise
for an error of a component, which carries a note that says where it arose. An error without a
note is a bug in acwm and keeps its traceback.
"""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Generator, Iterable, Sequence
from pathlib import Path
from typing import Any


class AcwmError(Exception):
    """Base of every error a user can cause and fix."""

    exit_code = 2


class RecipeError(AcwmError):
    """A recipe or an override is wrong: unknown component, parameter, type or file."""


class MissingExtraError(AcwmError):
    """An optional dependency is not installed; the message names the extra to install."""


class PluginError(AcwmError):
    """A plugin breaks its contract: a name already taken, a missing target, a wrong result."""


class ShapeError(AcwmError, ValueError):
    """An array, a tensor or an action has the wrong shape, dtype or range."""


class DataError(AcwmError):
    """A dataset, checkpoint or result is missing, damaged, or not the requested one."""


class TrainingError(AcwmError):
    """Training cannot start or go on: NaN loss, a run folder in use, nothing to resume."""


class AcwmWarning(UserWarning):
    """A warning for users; commands show it as one sentence, without a file and line."""


class Note(str):
    """A note on an error that says where it arose. Other libraries add notes of their own."""


@contextlib.contextmanager
def noting(
    where: str, *components: object, unless: type[Exception] | tuple[()] = ()
) -> Generator[None]:
    """Add a note to every error that passes, e.g. ``"in episode 3 of train (mine.py:12)"``.

    Args:
        where: a phrase that begins with a preposition.
        *components: components that run in the block, or modules by name. The note names the last
            line in one of their packages.
        unless: errors that get no note, such as an `AcwmError` that is complete.
    """
    try:
        yield
    except unless:
        raise
    except Exception as error:
        error.add_note(
            Note(where + _line(error, {_package(component) for component in components}))
        )
        raise


def _package(component: object) -> str:
    """The top-level package of a module, or of the class or instance of a component."""
    module = component if isinstance(component, str) else component.__module__
    return module.partition(":")[0].partition(".")[0]


def _line(error: BaseException, packages: set[str]) -> str:
    """``" (file:line)"`` of the last line of the traceback in one of `packages`, if there is one.

    Empty if the error has another note with a line already: that is nearer to its cause.
    """
    if any(note.endswith(")") for note in notes(error)):
        return ""
    for frame, line in reversed([*traceback.walk_tb(error.__traceback__)]):
        if _package(str(frame.f_globals.get("__name__"))) in packages:
            path, here = Path(frame.f_code.co_filename), Path.cwd()
            return f" ({path.relative_to(here) if path.is_relative_to(here) else path}:{line})"
    return ""


def notes(error: BaseException) -> list[Note]:
    """The notes that `noting` added to an error, also in another process."""
    return [note for note in getattr(error, "__notes__", ()) if isinstance(note, Note)]


def is_for_users(error: BaseException) -> bool:
    """Whether to show an error as a sentence: it is made for users, or arose in a component."""
    return isinstance(error, AcwmError) or bool(notes(error))


def sentence(error: BaseException) -> str:
    """An error in one line: ``"ValueError: message, in episode 3 of train (mine.py:12)"``.

    The type is left out for an `AcwmError`, whose message is made for users.
    """
    message = " ".join(str(error).split())
    if not isinstance(error, AcwmError):
        message = f"{type(error).__name__}: {message}".removesuffix(": ")
    return ", ".join([message, *notes(error)])


def check_shape(component: object, method: str, result: Any, *shape: int) -> None:
    """Refuse what a method of a component returned unless it has this shape.

    A wrong shape might be broadcast, and give a wrong result instead of an error.

    Args:
        component: the component, which the message names.
        method: the method, for the message.
        result: what it returned: an array or a tensor.
        *shape: the shape it must have; -1 stands for any length.

    Raises:
        PluginError: it has another shape, or none.
    """
    actual: Any = getattr(result, "shape", None)
    if (
        actual is None
        or len(actual) != len(shape)
        or any(wanted not in (-1, length) for length, wanted in zip(actual, shape, strict=True))
    ):
        gave = f"{result!r:.40}" if actual is None else f"the shape {[*actual]}"
        wanted = f"{[*shape]}".replace("-1", "n")
        owner = f"{type(component).__module__}.{type(component).__qualname__}"
        raise PluginError(f"{owner}.{method} gives {gave}, not the shape {wanted}")


def few(phrases: Sequence[str], most: int = 3) -> str:
    """The first of some phrases, and how many more there are."""
    left = len(phrases) - most
    return "; ".join([*phrases[:most], *([f"{left} more"] if left > 0 else [])])


def expect(condition: object, problem: str) -> None:
    """Raise a `DataError` with the phrase `problem` unless `condition` holds."""
    if not condition:
        raise DataError(problem)


def unknown_name(kind: str, name: str, known: Iterable[str], hint: str = "") -> RecipeError:
    """The error that there is no `kind` of this name; suggests the most similar of the `known`.

    Args:
        hint: a last sentence, e.g. how to list the names.
    """
    return RecipeError(f"unknown {kind} {name!r}{suggest(name, known)} {hint}".rstrip())


def suggest(name: str, known: Iterable[str]) -> str:
    """`"; did you mean 'x'?"`, or at most eight of the known names if none is similar."""
    import difflib

    names = sorted(known)
    near = [full for full in names if full.endswith(f".{name}")]  # a task without its environment
    near = near or difflib.get_close_matches(str(name), names, n=1, cutoff=0.5)  # YAML has numbers
    if near:
        return f"; did you mean {near[0]!r}?"
    if not names:
        return "; there is none."
    listed = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
    return f"; known: {listed}."
