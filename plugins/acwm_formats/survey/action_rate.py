"""Actions that come at another rate than frames: what became of them, and what the video follows.

Of several actions to a frame, targets such as positions act by their value at the frame, and
velocities, forces and steps by their sum over the frame. Which of the two a source means is often
nowhere in it, so it is found by what can be read from the changes of the video. A robot that
reaches its targets late follows their mean, too, but what moved one way moves back, as the next
target replaces the last; what a velocity, force or step has moved stays there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, cast

import numpy as np
from scipy import stats

from acwm_formats.survey.following import BEFORE, CERTAIN, FEWEST, LEAST, Moments, Seen, varying
from acwm_formats.survey.regression import Numbers
from acwm_formats.survey.response import lasting

SOURCE = "action_rate"
"""The key of the source in a dataset's card."""

SHIFTS = range(-2, 3)
COUNTS = ("", "", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")
ALSO = "--action-kind velocity, torque or delta"
LASTS = 0.8  # share of a motion that stays; with targets at most 0.75, unless they take seconds

Followed = Literal["value", "sum", "both", ""]


@dataclass(frozen=True)
class ActionRate:
    """How actions of another rate were brought to the frames.

    Attributes:
        per_frame: actions per frame, least and most over the recordings.
        unused: share of the actions that are at no frame.
        kinds: what actions command, as the import took it; several if dimensions differ.
        stated: whether the user or the source says so. If not, they were held.
        follows: what the video follows if it is not stated: the value at a frame or the sum over
            it, or both if actions differ; empty if that cannot be told.
        told: the shares of the value (or of its change, if the video follows the value), and of
            the sum, that can be read from the frames.
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
        if self.follows == "sum":
            return (
                "the video follows their sum over a frame rather than the value that was "
                f"used ({total} of the sum is read from the frames, {value} of the value): are "
                "they velocities or forces? Import again with --action-kind velocity, torque or "
                "delta, or with absolute if they are targets that the robot reaches late"
            )
        if self.follows == "value":
            return (
                "the video moves as their values change, as targets make it "
                f"({value} of the change is read from the frames, {total} of the sum over a "
                f"frame): give --action-kind absolute if they are targets; else {ALSO}"
            )
        if self.follows == "both":
            return (
                "the video follows the values of some and the sums over a frame of others: give a "
                "kind for each, in order, such as --action-kind delta,delta,absolute"
            )
        return (
            f"velocities or forces? The video does not tell: import again with {ALSO}, or with "
            "absolute for targets, or with a kind for each, in order, such as delta,delta,absolute"
        )

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
                cast(Followed, follows if follows in ("value", "sum", "both") else ""),
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

    A target moves what follows it by as much as the target itself moves, so what is read of it from
    the change of frames is how much the value changes. Velocities, steps and forces are read as
    they are, and better as sums than by the value at one instant.

    Args:
        values: stretches with the value that holds at each frame.
        sums: the same stretches with the mean until the next frame.

    Returns:
        Which, empty if it cannot be told; and the shares of the value, or of its change if that is
        read best, and of the sum that are read from the frames.
    """
    least = 2 * SHIFTS[-1] + BEFORE + 5
    pairs = [pair for pair in zip(values, sums, strict=True) if len(pair[0].actions) >= least]
    if len(pairs) < FEWEST:
        return "", (0.0, 0.0)
    held, summed = ([_shortened(side) for side in sides] for sides in zip(*pairs, strict=True))
    changes = [replace(pair[0], actions=np.diff(pair[0].actions, axis=0)) for pair in pairs]
    changes = [replace(side, frames=side.frames[:-1]) for side in changes]
    varies = varying(held) & varying(summed) & varying(changes)
    if not varies.any():
        return "", (0.0, 0.0)
    seen = [Seen(side, varies, SHIFTS[-1]) for side in (held, summed, changes)]
    parts = [np.stack([side.moved(shift) for shift in SHIFTS]) for side in seen]
    best = np.clip(np.max([part.mean(2).max(0) for part in parts], axis=0), 0, 1)
    whole, shares = _verdict(seen[1], parts, best)
    apart = {_verdict(seen[1], parts, best * one)[0] for one in np.eye(len(best))}
    return "both" if {"value", "sum"} <= apart else whole, shares


def _verdict(
    summed: Seen, parts: Sequence[Numbers], weights: Numbers
) -> tuple[Followed, tuple[float, float]]:
    """What `followed` returns, of actions that count by `weights`.

    Args:
        summed: the stretches with the means until the next frame.
        parts: how well value, sum and change are read, each ``[shift, action, group]``.
    """
    weights = weights / max(weights.sum(), 1e-12)
    rows = [np.einsum("sag,a->sg", part, weights) for part in parts]
    shifts = [int(row.mean(1).argmax()) for row in rows]
    value, total, change = (row[shift] for row, shift in zip(rows, shifts, strict=True))
    if change.mean() > value.mean() and _exceeds(change, total):
        return "value", _percent(change, total)
    if not _exceeds(total, value):
        return "", _percent(value, total)
    stays, error = lasting(summed, SHIFTS[shifts[1]], weights)
    return "sum" if stays - 2 * error > LASTS else "", _percent(value, total)


def _shortened(stretch: Moments) -> Moments:
    """A stretch without its last frame, before which no value changes."""
    return replace(stretch, frames=stretch.frames[:-1], actions=stretch.actions[:-1])


def _percent(value: Numbers, total: Numbers) -> tuple[float, float]:
    first, second = np.clip([value.mean(), total.mean()], 0, 1).tolist()
    return first, second


def _exceeds(more: Numbers, less: Numbers) -> bool:
    """Whether shares of groups are greater than others, by more than chance would make them."""
    gain = more - less
    error = gain.std(ddof=1) / np.sqrt(len(gain))
    limit = float(stats.t.isf(CERTAIN / 2, len(gain) - 1))
    return bool(gain.mean() > LEAST and gain.mean() > limit * max(float(error), 1e-12))
