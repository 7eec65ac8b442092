"""How a command's process starts and ends: Ctrl-C, warnings, and no module from the folder."""

from __future__ import annotations

import os
import signal
import sys
import warnings
from types import FrameType
from typing import NoReturn

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""

SHOW_CURSOR = b"\x1b[?25h"
"""Terminal code that shows the cursor again, in case a progress bar has hidden it."""


def begin_process() -> None:
    """Prepare the process of a command, before anything heavy is imported."""
    os.environ["PYTHONSAFEPATH"] = "1"  # no child imports modules from the working folder
    _keep_warnings_from_being_errors()
    handle_interrupts()


def _keep_warnings_from_being_errors() -> None:
    """Forget PYTHONWARNINGS=error, here and in children: other libraries warn where they please."""
    if any(option.startswith("e") for option in sys.warnoptions):
        sys.warnoptions.clear()
        os.environ.pop("PYTHONWARNINGS", None)
        warnings.resetwarnings()
        hidden = (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning)
        for usual in hidden:  # as Python does by itself
            warnings.simplefilter("ignore", usual)


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
