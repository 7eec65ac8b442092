"""Actions that come at another rate than frames: what became of them, and what the video follows.

Of several actions to a frame, targets such as positions act by their value at the frame, and
velocities, forces and steps by their sum over the frame. Which of the two a source means is often
nowhere in it, so both are read from the changes of the video, as `following` reads actions.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, cast

import numpy as np
from scipy import stats

from acwm_formats.survey.following import BEFORE, CERTAIN, FEWEST, LEAST, Moments, Seen, varying
from acwm_formats.survey.regression import Numbers

SOURCE = "action_rate"
"""The key of the source in a dataset's card."""

SHIFTS = range(-2, 3)
COUNTS = ("", "", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
ALSO = "--action-kind absolute, velocity, torque or delta"

Followed = Literal["value", "sum", ""]


@dataclass(frozen=True)
class ActionRate:
    """How actions of another rate were brought to the frames.

    Attributes:
        per_frame: actions per frame, least and most over the recordings.
        unused: share of the actions that are at no frame.
        kinds: what actions command, as the import took it; several if dimensions differ.
        stated: whether the user or the source says so. If not, they were held.
        follows: what the video follows if it is not stated: the value at a frame or the sum over
            it; empty if that cannot be told.
        told: the shares of the value, and of the sum, that can be read from the frames.
    """

    per_frame: tuple[float, float]
    unused: float
    kinds: tuple[str, ...]
    stated: bool
    follows: Followed = ""
    told: tuple[float, float] = (0.0, 0.0)

    @property
    def is_open(self) -> bool:
        """Whether actions were left out of which nobody says that this is right."""
        return not self.stated and self.unused > 0

    @property
    def sentence(self) -> str:
        """How often actions come, and what became of them."""
        low, high = self.per_frame
        if not self.unused and high < 1:
            return f"actions come once in {1 / high:.3g} frames; {self._slow}"
        near = f"{low:.2g}" == f"{high:.2g}"
        times = _times(high) if near else f"{_times(low)} to {_times(high)}"
        return f"actions come {times} times per frame; {self._fast}"

    @property
    def question(self) -> str:
        """What is to be decided, if it `is_open`."""
        value, total = (f"{100 * share:.0f} %" for share in self.told)
        shares = f"{total} of the sum is read from the frames, {value} of the value"
        if self.follows == "sum":
            return (
                "the video follows their sum over a frame rather than the value that was "
                f"used ({shares}): are they velocities or forces? Import again with --action-kind "
                "velocity, torque "
                "or delta, or with absolute if they are targets that the robot reaches late"
            )
        if self.follows == "value":
            return (
                f"the video follows their values rather than their sum over a frame ({shares}): if "
                f"they are targets, give --action-kind absolute; velocities or forces? {ALSO}"
            )
        return f"velocities or forces? Import again with {ALSO}"

    @property
    def _fast(self) -> str:
        if {*self.kinds} <= {"velocity", "torque"}:
            return "averaged over each frame"
        if {*self.kinds} == {"delta"}:
            return "summed over each frame"
        if {*self.kinds} != {"absolute"}:
            return "held, averaged or summed by kind"
        count = round(1 / max(1 - self.unused, 1e-9))
        if 2 <= count < len(COUNTS):
            return f"held: one of {COUNTS[count]} is used"
        return f"held: {100 * (1 - self.unused):.0f} % of them are used"

    @property
    def _slow(self) -> str:
        spread = {*self.kinds} == {"delta"}
        return "each is spread over its frames" if spread else "each is held until the next"

    def to_source(self) -> dict[str, Any]:
        """For the source in a card."""
        plain = {n: list(v) if isinstance(v, tuple) else v for n, v in asdict(self).items()}
        return {SOURCE: plain}

    @classmethod
    def of_source(cls, source: Mapping[str, Any]) -> ActionRate | None:
        """What an import wrote; None if frames have an action each, or nothing tells."""
        stored = source.get(SOURCE)
        if not isinstance(stored, Mapping):
            return None
        try:
            known = cast(Mapping[str, Any], stored)
            low, high = map(float, known["per_frame"])
            value, total = map(float, known["told"])
            follows = str(known["follows"])
            rate = cls(
                (low, high),
                float(known["unused"]),
                tuple(map(str, known["kinds"])),
                bool(known["stated"]),
                cast(Followed, follows if follows in ("value", "sum") else ""),
                (value, total),
            )
        except (KeyError, TypeError, ValueError):
            return None
        numbers = (low, high, rate.unused, value, total)
        return rate if all(map(math.isfinite, numbers)) and high > 0 else None


def _times(number: float) -> str:
    return f"{number:.1f}" if number >= 1.95 else f"{number:.2f}"


def followed(
    values: Sequence[Moments], sums: Sequence[Moments]
) -> tuple[Followed, tuple[float, float]]:
    """Whether videos follow the values of actions at the frames or their sums over the frames.

    Args:
        values: stretches with the value that holds at each frame.
        sums: the same stretches with the mean until the next frame.

    Returns:
        Which, empty if it cannot be told; and the shares of either that are read from the frames.
        Sums are read better as a whole, of forces too, which act late; values are read better in
        what is new in them.
    """
    least = 2 * SHIFTS[-1] + BEFORE + 4
    pairs = [pair for pair in zip(values, sums, strict=True) if len(pair[0].actions) >= least]
    if len(pairs) < FEWEST:
        return "", (0.0, 0.0)
    sides = [list(side) for side in zip(*pairs, strict=True)]
    varies = varying(sides[0]) & varying(sides[1])
    if not varies.any():
        return "", (0.0, 0.0)
    seen = [Seen(side, varies, SHIFTS[-1]) for side in sides]
    whole = _shares([np.stack([side.plain(shift) for shift in SHIFTS]) for side in seen])
    news = _shares([np.stack([side.new(shift) for shift in SHIFTS]) for side in seen])
    limit = float(stats.t.isf(CERTAIN / 2, whole.shape[1] - 1))
    more, newer = whole[1] - whole[0], news[1] - news[0]
    if _size(more) > limit and more.mean() > LEAST:
        return "sum", _means(whole)
    if _size(newer) < -limit and newer.mean() < -LEAST and _size(more) < 1:
        return "value", _means(news)
    return "", _means(whole)


def _shares(parts: Sequence[Numbers]) -> Numbers:
    """What is read of the value and of the sum by each group, at the best shift of either.

    Args:
        parts: of each ``[shift, action, group]``.
    """
    best = np.clip(np.max([part.mean(2).max(0) for part in parts], axis=0), 0, 1)
    weights = best / max(best.sum(), 1e-12)
    rows = [np.einsum("sag,a->sg", part, weights) for part in parts]
    return np.stack([row[int(row.mean(1).argmax())] for row in rows])


def _means(shares: Numbers) -> tuple[float, float]:
    value, total = np.clip(shares.mean(1), 0, 1).tolist()
    return value, total


def _size(values: Numbers) -> float:
    """The mean in standard errors."""
    error = values.std(ddof=1) / np.sqrt(len(values))
    return float(values.mean() / max(error, 1e-12))
