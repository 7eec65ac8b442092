"""When messages of a log were taken: by the stamps in their headers, or as they were logged.

A log notes when a message arrived, which for pictures may be a quarter of a second after they were
taken. Stamps in headers are of the sender. They are taken where they can be compared: if they are
of the clock of the log, or all of one clock of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Stamps = Literal["header", "log"]

LATEST = 10**9  # ns after its stamp at which a message of the log's own clock is logged at most
EARLY = 5 * 10**6  # ns by which clocks differ that are one
SAME = 10**6  # ns: a difference that does not matter


class TopicClock(NamedTuple):
    """Times of the messages of one topic, in ns.

    Attributes:
        logged: when each was logged.
        stamps: what its header says; 0 if it has none.
    """

    logged: NDArray[np.int64]
    stamps: NDArray[np.int64]

    @property
    def is_stamped(self) -> bool:
        """Whether headers say when messages were taken: in all, each later than the last."""
        steps = np.diff(self.stamps)
        return len(steps) > 0 and bool((self.stamps > 0).all() and (steps > 0).all())

    @property
    def goes_back(self) -> bool:
        """Whether headers say it, but not in the order of the messages."""
        return bool((self.stamps > 0).all()) and bool((np.diff(self.stamps) < 0).any())

    @property
    def late(self) -> int:
        """By how much messages were usually logged after they were taken, in ns."""
        return int(np.median(self.logged - self.stamps))


def times_of(
    clocks: Mapping[str, TopicClock], wanted: Stamps | None
) -> dict[str, NDArray[np.int64]]:
    """The times of the messages of each topic, all on one clock, in ns.

    Args:
        clocks: by topic.
        wanted: whose times to take; by default those of headers, where they can be compared.
    """
    stamped = _stamped(clocks, wanted)
    return {
        name: clock.stamps if name in stamped else clock.logged for name, clock in clocks.items()
    }


def _stamped(clocks: Mapping[str, TopicClock], wanted: Stamps | None) -> set[str]:
    """The topics whose headers count."""
    have = {name for name, clock in clocks.items() if clock.is_stamped}
    near = {name for name in have if -EARLY <= clocks[name].late <= LATEST}
    if wanted == "log":
        return set()
    late = [clocks[name].late for name in have]
    own = have == clocks.keys() and max(late, default=0) - min(late, default=0) <= LATEST
    return have if wanted == "header" or (own and near != have) else near


def clock_note(clocks: Mapping[str, TopicClock], wanted: Stamps | None) -> str:
    """Which times were taken, for people."""
    stamped, have = _stamped(clocks, wanted), {n for n, clock in clocks.items() if clock.is_stamped}
    late = [
        f"{name} {clocks[name].late / 1e9:.3g} s before it was logged"
        for name in clocks
        if name in stamped and abs(clocks[name].late) > SAME
    ]
    if late:
        others = ", and the log's for the others" if stamped != clocks.keys() else ""
        return (
            f"times are those of headers{others}: {', '.join(late)} (--stamps log takes the log's)"
        )
    if left := sorted(have - stamped):
        why = "as asked" if wanted == "log" else "as others have none of the same clock"
        return f"times are those of the log, and not of the headers of {', '.join(left)}, {why}"
    back = sorted(name for name, clock in clocks.items() if clock.goes_back)
    why = f"; stamps go back in the headers of {', '.join(back)}" if back else ""
    return f"times are those of the log{why}"
