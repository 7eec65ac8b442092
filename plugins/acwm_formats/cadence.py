"""The rate at which frames come, measured from their times, and the frames that were lost."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SAME = 0.005  # rates that differ by this share are the same, since clocks differ
QUARTER = 0.25  # of a frame: so far may times drift away from a rate over a whole recording
JITTER = 0.35  # of a frame: so far may a frame be from its regular time
HALF = 0.5  # of a frame: farther off, a frame could as well be the next one
LATE = 1.75  # intervals after a frame at which the next one is certain to be missing


class Cadence(NamedTuple):
    """The regular times of frames.

    Attributes:
        slots: ``[N]`` for each frame its place, counted from 0 also over lost frames.
        step: seconds from one place to the next.
        late: how many places the first frame comes after time 0.
        irregular: why they are not regular; empty if they are.
    """

    slots: NDArray[np.int64]
    step: float
    late: int
    irregular: str

    @property
    def places(self) -> int:
        """Number of places."""
        return int(self.slots[-1]) + 1

    @property
    def rate(self) -> float:
        """Frames per second."""
        return 1 / self.step

    def is_at(self, rate: Fraction | float) -> bool:
        """Whether it is this rate, as precisely as the frames tell."""
        return abs(float(rate) * self.step - 1) <= SAME + QUARTER / self.places


def cadence(times: NDArray[np.float64]) -> Cadence:
    """Measure the cadence of increasing `times`, two at least."""
    steps = np.diff(times)
    usual = float(np.median(steps))
    slots = np.arange(len(times))
    start, step = _line(slots, times)
    even = np.abs(times - start - step * slots).max() <= JITTER * step
    if not (even and steps.max() < LATE * usual):
        slots = np.concatenate([[0], np.cumsum(np.maximum(1, np.rint(steps / usual)))])
        slots = slots.astype(np.int64)
        start, step = _line(slots, times)
    off = np.abs(times - start - step * slots).max() / step
    why = f"one frame is {off:.2g} frame intervals off its time" if off > HALF else ""
    late = round(float(times[0]) / step)  # unless the clock began long before
    return Cadence(slots, step, late if 0 < late <= len(times) else 0, why)


def _line(slots: NDArray[np.int64], times: NDArray[np.float64]) -> tuple[float, float]:
    """Start and step of the regular times that fit best."""
    if len(slots) == 2:
        return float(times[0]), float(times[1] - times[0]) / int(slots[1])
    step, start = np.polyfit(slots, times - times[0], 1)
    return float(times[0] + start), float(step)


def faults(times: NDArray[np.float64]) -> tuple[NDArray[np.bool_], list[str]]:
    """Which of the times follow all before them, and what is wrong with the others."""
    kept = np.isfinite(times)
    problems = [f"{np.sum(~kept)} have no time"] if not kept.all() else []
    latest = np.maximum.accumulate(np.where(kept, times, -np.inf))
    back = kept & (times < latest)
    if back.any():
        place = int(np.argmax(back))
        problems.append(
            f"time goes back from {latest[place]:.6g} to {times[place]:.6g} s at {place}"
        )
    same = kept & ~back & (times == np.concatenate([[-np.inf], latest])[: len(times)])
    if same.any():
        place = int(np.argmax(same))
        problems.append(f"{np.sum(same)} have the time of the frame before: {times[place]:.6g} s")
    return kept & ~back & ~same, problems


def common_rate(
    measured: Iterable[tuple[float, float]], candidates: Iterable[Fraction]
) -> Fraction | None:
    """The exact rate of recordings that were measured.

    Args:
        measured: frames per second and seconds of each.
        candidates: rates that are stated somewhere, the likeliest first.

    Returns:
        The first candidate or usual rate that all of them follow to a quarter of a frame, else the
        one closest to the longest; None if there is none.
    """
    rates = [(rate, seconds) for rate, seconds in measured if rate > 0]
    if not rates:
        return None
    rate, seconds = max(rates, key=lambda pair: pair[0] * pair[1])
    whole = Fraction(round(rate)) if round(rate) else Fraction(rate).limit_denominator(1000)
    for candidate in (*candidates, whole, whole * Fraction(1000, 1001)):
        if abs(float(candidate) / rate - 1) * seconds * rate <= QUARTER:
            return candidate
    return Fraction(rate).limit_denominator(1001)
