"""CPU threads beside other programs. Imports torch late: its threads read the environment."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

STAT = Path("/proc/stat")
"""Linux's count of what the cores have done."""

LOOK_S = 0.3
"""For how many seconds the load of the cores is measured."""


def idle_cores() -> float:
    """How many of the cores that this process may use are idle, over `LOOK_S` seconds.

    Where that cannot be known, all of them.
    """
    if not STAT.exists():
        return os.cpu_count() or 1
    own = {f"cpu{core}" for core in os.sched_getaffinity(0)}

    def idle_seconds() -> float:
        counts = [line.split() for line in STAT.read_text(encoding="utf-8").splitlines()]
        ticks = sum(int(count[4]) + int(count[5]) for count in counts if count[0] in own)
        return ticks / os.sysconf("SC_CLK_TCK")

    before, started = idle_seconds(), time.monotonic()
    time.sleep(LOOK_S)
    return (idle_seconds() - before) / (time.monotonic() - started)


def wait_without_spinning() -> None:
    """Let torch's idle threads sleep if other programs use the cores; call before importing torch.

    Spinning is faster on idle cores, but wastes shared ones. If the user has set OMP_WAIT_POLICY or
    OMP_NUM_THREADS, nothing is changed.
    """
    is_decided = {"OMP_WAIT_POLICY", "OMP_NUM_THREADS"} & {*os.environ} or "torch" in sys.modules
    if STAT.exists() and not is_decided and len(os.sched_getaffinity(0)) - idle_cores() > 0.5:
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"


def use_threads(asked: int | None, before: int | None, *, choose: bool) -> int | None:
    """Set the number of torch's threads and return it, or None if it is torch's default.

    One is chosen as torch does, but no more than there are idle cores if waiting threads spin: two
    that spin on two busy cores train 6 times as slowly as one, two that sleep 1.1 times.

    Args:
        asked: the number of the recipe; OMP_NUM_THREADS says otherwise only if there is none.
        before: that of the run that is resumed, for bitwise equal results.
        choose: choose a number if there is neither.
    """
    import torch

    is_free = "OMP_NUM_THREADS" not in os.environ
    threads = asked or before
    if threads is None and choose:
        threads = torch.get_num_threads()
        if is_free and os.environ.get("OMP_WAIT_POLICY", "").upper() != "PASSIVE":
            threads = min(threads, max(1, round(idle_cores())))
    if threads and (is_free or asked):
        torch.set_num_threads(threads)
    return threads
