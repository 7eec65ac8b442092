"""Compares contacts in the predicted video with those of the simulator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.physics import Gap, Physics
from acwm_core.evaluation.metric import Prediction
from acwm_metrics.physical import PhysicalMetric, instance_id, physics_of
from acwm_metrics.seen import measured, share_found, shown

WINDOW = 5
"""Largest difference in frames between the onsets of two contacts that count as the same."""

BREAK = 3
"""Fewest frames without contact that end a contact; shorter separations are ignored."""


@dataclass(frozen=True)
class Onsets:
    """The onsets of contact between two bodies, and which onsets belong together.

    Attributes:
        seen: frames of onsets in the prediction.
        true: frames of onsets in truth.
        pairs: matching onsets, as (index in `seen`, index in `true`).
        lost: frames of true onsets without a match of which a body is not found then.
    """

    seen: NDArray[np.int64]
    true: NDArray[np.int64]
    pairs: list[tuple[int, int]]
    lost: NDArray[np.int64]


class ContactMetric(PhysicalMetric):
    """Base of the scores of when bodies come into contact.

    An event is the onset of a contact: two bodies touch that did not touch in the frames before. A
    contact in frame 0 is not an event. In the prediction, bodies touch where their distance, as
    read by the estimator, is below a threshold. A body that is not found touches nothing: it misses
    its contacts, and each counts as the worst. Clips are weighted by their number of events, so
    the summary is the mean over all events of all clips.
    """

    group = "Contacts"
    definition = 2

    def lacking(self, physics: Physics) -> str | None:
        told = any(gap.touch is not None for gap in physics.gaps)
        return None if told else "no contacts that can be detected"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The mean over the events in each frame, `[T]`; NaN for a frame without events."""
        frames, scores = self._events(prediction)
        sums = np.bincount(frames, scores, len(prediction.masks))
        events = np.bincount(frames, minlength=len(prediction.masks))
        return np.where(events > 0, sums / np.maximum(events, 1), np.nan)

    def value(self, prediction: Prediction) -> float:
        """The mean over all events of the clip; NaN if it has none."""
        scores = self._events(prediction)[1]
        return float(scores.mean()) if len(scores) else float("nan")

    def weight(self, prediction: Prediction) -> float:
        """The number of events."""
        return float(len(self._events(prediction)[1]))

    def coverage(self, prediction: Prediction, curve: NDArray[np.float64]) -> float:
        """Share of the bodies and frames in which a state is found."""
        return share_found(prediction, physics_of(prediction).readings)

    def _events(self, prediction: Prediction) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Frames and scores of all events."""
        found = [(f, s) for each in onsets(prediction) for f, s in self._scored(each, prediction)]
        frames, scores = zip(*found, strict=True) if found else ((), ())
        return np.array(frames, np.int64), np.array(scores, np.float64)

    def _scored(self, onsets: Onsets, prediction: Prediction) -> Iterator[tuple[int, float]]:
        raise NotImplementedError


class ContactPrecision(ContactMetric):
    """Share of the predicted contacts that happen in truth, within 5 frames.

    A true contact of a body that is not found then counts as a wrong one.
    """

    name = "contact_precision"
    bounds = (0.0, 1.0)
    higher_is_better = True

    def _scored(self, onsets: Onsets, prediction: Prediction) -> Iterator[tuple[int, float]]:
        right = {seen for seen, _ in onsets.pairs}
        yield from ((int(f), float(k in right)) for k, f in enumerate(onsets.seen))
        yield from ((int(f), 0.0) for f in onsets.lost)


class ContactRecall(ContactMetric):
    """Share of the true contacts that are predicted, within 5 frames."""

    name = "contact_recall"
    bounds = (0.0, 1.0)
    higher_is_better = True

    def _scored(self, onsets: Onsets, prediction: Prediction) -> Iterator[tuple[int, float]]:
        found = {true for _, true in onsets.pairs}
        return ((int(f), float(k in found)) for k, f in enumerate(onsets.true))


class ContactTiming(ContactMetric):
    """How much too early or too late correctly predicted contacts begin.

    A true contact of a body that is not found then counts as 5 frames off.
    """

    name = "contact_timing"
    unit = "s"

    def _scored(self, onsets: Onsets, prediction: Prediction) -> Iterator[tuple[int, float]]:
        for seen, true in onsets.pairs:
            off = abs(int(onsets.seen[seen]) - int(onsets.true[true]))
            yield int(onsets.true[true]), off * self._frame(prediction)
        yield from ((int(f), WINDOW * self._frame(prediction)) for f in onsets.lost)

    def _frame(self, prediction: Prediction) -> float:
        return 1 / prediction.card.fps


class ContactTimingInFrames(ContactTiming):
    """The error of `contact_timing` in frames."""

    name = "contact_timing_frames"
    unit = "frames"

    def _frame(self, prediction: Prediction) -> float:
        return 1.0


def onsets(prediction: Prediction) -> list[Onsets]:
    """The contact onsets of every pair of bodies, in prediction and truth."""
    return prediction.once(onsets, lambda: list(_onsets(prediction)))


def _onsets(prediction: Prediction) -> Iterator[Onsets]:
    for gap in physics_of(prediction).gaps:
        if gap.touch is None:
            continue
        distance = measured(gap, prediction)
        seen = beginnings(distance < gap.touch)
        true = beginnings(true_contacts(prediction, gap))
        pairs = matched(seen, true)
        missed = np.delete(true, [place for _, place in pairs])
        unseen = np.isnan(distance) & shown(prediction, _bodies(prediction, gap)).all(1)
        yield Onsets(seen, true, pairs, missed[unseen[missed]])


def _bodies(prediction: Prediction, gap: Gap) -> list[str]:
    """The instances of a pair whose states are read; others, as walls, stay where they are."""
    read = {name for each in physics_of(prediction).readings for name in each.instances}
    return [name for name in gap.pair if name in read]


def true_contacts(prediction: Prediction, gap: Gap) -> NDArray[np.bool_]:
    """Whether two bodies touch in the simulator in each frame, `[T]`."""
    pair = sorted(instance_id(prediction, name) for name in gap.pair)
    rows = prediction.contacts[(prediction.contacts[:, 1:] == pair).all(1)]
    touching = np.zeros(len(prediction.masks), np.bool_)
    touching[rows[:, 0]] = True
    return touching


def first_contact(prediction: Prediction) -> int:
    """The frame of the first true contact that can be detected; T if there is none."""
    begun = [each.true[0] for each in onsets(prediction) if len(each.true)]
    return int(min(begun, default=len(prediction.masks)))


def beginnings(touching: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The frames at which contacts begin, after at least `BREAK` frames without contact."""
    frames = np.flatnonzero(touching)
    new = np.diff(frames, prepend=frames[:1] - 1 - BREAK if len(frames) else 0) > BREAK
    return frames[new & (frames > 0)] if len(frames) else frames


def matched(seen: NDArray[np.int64], true: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Pair onsets at most `WINDOW` frames apart, the closest first, each used once."""
    near = sorted(
        (abs(int(s) - int(t)), i, j)
        for i, s in enumerate(seen)
        for j, t in enumerate(true)
        if abs(int(s) - int(t)) <= WINDOW
    )
    used: tuple[set[int], set[int]] = set(), set()
    pairs: list[tuple[int, int]] = []
    for _, i, j in near:
        if i not in used[0] and j not in used[1]:
            used[0].add(i)
            used[1].add(j)
            pairs.append((i, j))
    return pairs
