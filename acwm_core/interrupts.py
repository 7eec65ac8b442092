"""Ctrl-C ends a command at any moment, with one line and exit code 130; its workers leave it alone.

Imports nothing that takes time, so that it can be told first of all.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from collections.abc import Generator
from types import FrameType
from typing import NoReturn

INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""

SHOW_CURSOR = b"\x1b[?25h"
"""What a terminal is told, in case that a progress bar has hidden it."""


def handle_interrupts() -> None:
    """Let this process, which is a command, end well by Ctrl-C."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as of background jobs
        signal.signal(signal.SIGINT, interrupt)
    sys.unraisablehook = _unraisable


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raise `KeyboardInterrupt`; but end at once where modules are imported.

    There is nothing to clean up yet, and what is imported may take the exception for an error of
    its own, print it, or swallow it.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            leave()
        frame = frame.f_back
    raise KeyboardInterrupt


def leave() -> NoReturn:
    """End this process now."""
    os.write(2, SHOW_CURSOR * os.isatty(2) + b"acwm: stopped\n")
    os._exit(INTERRUPTED)


@contextlib.contextmanager
def without_interrupts() -> Generator[None]:
    """Hold Ctrl-C back for a moment; processes that are started meanwhile leave it to this one.

    They inherit the blocked signal, and so are not interrupted while they start, either.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _unraisable(raised: sys.UnraisableHookArgs) -> None:
    """Where Python would print an exception and go on, as in a destructor, Ctrl-C counts too."""
    if issubclass(raised.exc_type, KeyboardInterrupt):
        leave()
    sys.__unraisablehook__(raised)
