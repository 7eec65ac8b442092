"""Keeps a thread's scheduling as it was, whatever a library does to it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def scheduling_kept() -> Iterator[None]:
    """Give the calling thread the scheduling back that it has now.

    SVT-AV1 makes the thread that opens an encoder a real-time one of the highest priority if it
    may, as root in a container may. It would stay so: every other process then waits for it.
    """
    if not hasattr(os, "sched_getscheduler"):  # other systems than Linux
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)
