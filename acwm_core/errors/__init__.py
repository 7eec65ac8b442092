"""Errors for users: one clear sentence that says what to do next.

For every `AcwmError`, the command line prints only the message and exits with code 2. Any other
error is a bug in acwm and keeps its traceback.
"""

from __future__ import annotations

import os
import signal
import sys
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""

SHOW_CURSOR = b"\x1b[?25h"
"""Terminal code that shows the cursor again, in case a progress bar has hidden it."""


class AcwmError(Exception):
    """Base of every error a user can cause and fix."""

    exit_code = 2


class RecipeError(AcwmError):
    """A recipe or an override is wrong: unknown component, parameter, type or file."""


class UnknownNameError(RecipeError):
    """Nothing is registered under a name.

    Args:
        kind: what was looked for, e.g. ``"environment"``.
        name: the name that was not found.
        known: the existing names, to suggest the most similar one.
        hint: a last sentence, e.g. how to list the names.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str], hint: str = "") -> None:
        message = f"unknown {kind} {name!r}{suggest(name, known)}"
        super().__init__(f"{message} {hint}" if hint else message)


class MissingExtraError(AcwmError):
    """An optional dependency is not installed; the message names the extra to install."""


class PluginError(AcwmError):
    """A plugin breaks its contract: a name already taken, a missing target, a wrong base class."""


class ShapeError(AcwmError, ValueError):
    """An array or tensor has the wrong shape, dtype or range."""


class ActionError(AcwmError, ValueError):
    """An action has the wrong shape, is out of its bounds or not finite."""


class DataError(AcwmError):
    """A dataset is missing, damaged, or not the requested one."""


class OtherDatasetError(DataError):
    """The folder to write a dataset to already holds a different one.

    Args:
        folder: the folder.
        differences: how the datasets differ, as phrases.

    Attributes:
        found: the message without its advice, for callers that give their own.
    """

    def __init__(self, folder: Path, differences: Iterable[str]) -> None:
        self.found = f"{folder} holds another dataset: {'; '.join(differences)}"
        super().__init__(
            f"{self.found}. Choose another --out, or delete the folder to create it again"
        )


class DamagedShardError(DataError):
    """The bytes of a shard are damaged; the message names the file."""


class TrainingError(AcwmError):
    """Training cannot start or go on: NaN loss, a run folder in use, nothing to resume."""


class CheckpointError(AcwmError):
    """A checkpoint of another program does not contain what a model needs."""


def expect(condition: object, problem: str) -> None:
    """Raise a `DataError` with the phrase `problem` unless `condition` holds."""
    if not condition:
        raise DataError(problem)


class AcwmWarning(UserWarning):
    """A warning for users; commands show it as one sentence, without a file and line."""


class RenamedWarning(FutureWarning):
    """An old name was used; it works for one more release."""


def with_new_names(
    values: Mapping[str, Any], renamed: Mapping[str, str], where: str = ""
) -> dict[str, Any]:
    """Return `values` under their new names, with a `RenamedWarning` for every old name.

    Args:
        values: values by name, from a file or a command line.
        renamed: maps old names to new ones.
        where: prefix of the names in the warning, e.g. ``"evaluation."``.
    """
    for old in values:
        if old in renamed:
            message = f"{where}{old} is now called {where}{renamed[old]}"
            warnings.warn(message, RenamedWarning, stacklevel=2)
    return {renamed.get(name, name): value for name, value in values.items()}


def suggest(name: str, known: Iterable[str]) -> str:
    """`"; did you mean 'x'?"`, or at most eight of the known names if none is similar."""
    import difflib

    names = sorted(known)
    near = [each for each in names if each.endswith(f".{name}")]  # a task without its environment
    near = near or difflib.get_close_matches(str(name), names, n=1, cutoff=0.5)  # YAML has numbers
    if near:
        return f"; did you mean {near[0]!r}?"
    if not names:
        return "; there is none."
    listed = ", ".join(names[:8]) + (", …" if len(names) > 8 else "")
    return f"; known: {listed}."


def handle_interrupts() -> None:
    """Let Ctrl-C end the current command at any moment, with a one-line message."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in background jobs
        signal.signal(signal.SIGINT, _interrupt)
    sys.unraisablehook = _unraisable


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise `KeyboardInterrupt`, or exit at once while a module is being imported.

    During an import there is nothing to clean up yet, and the imported code could treat the
    exception as an error of its own, print it, or swallow it.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            _leave()
        frame = frame.f_back
    raise KeyboardInterrupt


def _unraisable(raised: sys.UnraisableHookArgs) -> None:
    """Exit on Ctrl-C even where Python prints exceptions and goes on, e.g. in a destructor."""
    if issubclass(raised.exc_type, KeyboardInterrupt):
        _leave()
    sys.__unraisablehook__(raised)


def _leave() -> NoReturn:
    os.write(2, SHOW_CURSOR * os.isatty(2) + b"acwm: stopped\n")
    os._exit(INTERRUPTED)


def exit_by_signal(number: int, _frame: object) -> NoReturn:
    """Handler of a signal such as SIGTERM: end with exit code 128 + its number."""
    raise SystemExit(128 + number)
