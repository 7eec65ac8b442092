"""Errors for users: one clear sentence that says what to do next.

The command line ends with exit code 2 and the message alone for every `AcwmError`; anything
else that escapes is a bug of ours and keeps its traceback.
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
"""Exit code after Ctrl-C, as shells have it."""

SHOW_CURSOR = b"\x1b[?25h"
"""What a terminal is told, in case that a progress bar has hidden it."""


class AcwmError(Exception):
    """Base of every error a user can cause and fix."""

    exit_code = 2


class RecipeError(AcwmError):
    """A recipe or an override is wrong: unknown component, parameter, type or file."""


class UnknownNameError(RecipeError):
    """A name that nothing is registered under.

    Args:
        kind: what was looked for, e.g. ``"environment"``.
        name: the name that was not found.
        known: the names that exist, to suggest the nearest.
        hint: a last sentence, e.g. how to list the names.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str], hint: str = "") -> None:
        message = f"unknown {kind} {name!r}{suggest(name, known)}"
        super().__init__(f"{message} {hint}" if hint else message)


class MissingExtraError(AcwmError):
    """An optional dependency is not installed; the message names the extra that brings it."""


class PluginError(AcwmError):
    """A plugin breaks the contract: a taken name, a target that does not exist, a bad base."""


class ShapeError(AcwmError, ValueError):
    """An array or tensor of the wrong shape, dtype or range."""


class ActionError(AcwmError, ValueError):
    """An action of the wrong shape, out of its bounds, or not finite."""


class DataError(AcwmError):
    """A dataset that is missing, damaged, or not the one that was asked for."""


class OtherDatasetError(DataError):
    """A folder that holds another dataset than the one that is to be made in it.

    Args:
        folder: which.
        differences: what is not alike, as phrases.

    Attributes:
        found: the message without what to do, for those who know it better.
    """

    def __init__(self, folder: Path, differences: Iterable[str]) -> None:
        self.found = f"{folder} holds another dataset: {'; '.join(differences)}"
        super().__init__(
            f"{self.found}. Choose another --out, or delete the folder to make it anew"
        )


class DamagedShardError(DataError):
    """A shard whose bytes are not what they should be; its message names the file."""


class TrainingError(AcwmError):
    """Training cannot start or resume: NaN loss, a run folder that is taken, nothing to resume."""


class CheckpointError(AcwmError):
    """A checkpoint of another program that does not hold what a model needs."""


def expect(condition: object, problem: str) -> None:
    """Raise a `DataError` with the phrase `problem` unless something holds."""
    if not condition:
        raise DataError(problem)


class AcwmWarning(UserWarning):
    """What a user should know and no error; commands show it as a sentence without a place."""


class RenamedWarning(FutureWarning):
    """An old spelling was used; it works for one more release."""


def with_new_names(
    values: Mapping[str, Any], renamed: Mapping[str, str], where: str = ""
) -> dict[str, Any]:
    """`values` under their new names, with a `RenamedWarning` for every old spelling.

    Args:
        values: what a file or a command line holds.
        renamed: new names by old ones.
        where: what stands before the names in the warning, e.g. ``"evaluation."``.
    """
    for old in values:
        if old in renamed:
            message = f"{where}{old} is now called {where}{renamed[old]}"
            warnings.warn(message, RenamedWarning, stacklevel=2)
    return {renamed.get(name, name): value for name, value in values.items()}


def suggest(name: str, known: Iterable[str]) -> str:
    """`"; did you mean 'x'?"`, or the known names if none is near (at most eight of them)."""
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
    """Have Ctrl-C end this process, which is a command, at any moment with one line."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as of background jobs
        signal.signal(signal.SIGINT, _interrupt)
    sys.unraisablehook = _unraisable


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise `KeyboardInterrupt`; but end at once where modules are imported.

    There is nothing to clean up yet, and what is imported may take the exception for an error of
    its own, print it, or swallow it.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            _leave()
        frame = frame.f_back
    raise KeyboardInterrupt


def _unraisable(raised: sys.UnraisableHookArgs) -> None:
    """Where Python would print an exception and go on, as in a destructor, Ctrl-C counts too."""
    if issubclass(raised.exc_type, KeyboardInterrupt):
        _leave()
    sys.__unraisablehook__(raised)


def _leave() -> NoReturn:
    os.write(2, SHOW_CURSOR * os.isatty(2) + b"acwm: stopped\n")
    os._exit(INTERRUPTED)


def exit_by_signal(number: int, _frame: object) -> NoReturn:
    """Handler of a signal such as SIGTERM: end with exit code 128 + its number."""
    raise SystemExit(128 + number)
