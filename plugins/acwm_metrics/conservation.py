"""Metrics of what must always hold: objects, lengths and amounts stay, solid bodies stay apart."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from acwm_core.env.physics import Constant, Gap, Physics
from acwm_core.evaluation.metric import Prediction
from acwm_metrics.physical import PhysicalMetric, physics_of, row_means, start_of, truth_of
from acwm_metrics.presence import out_of_sight, seen_once
from acwm_metrics.seen import (
    held_among_true,
    lost_of_pair,
    lost_shapes,
    measured,
    share_found,
)

LASTING = 3
"""Frames in a row for which solid bodies must overlap, so that it is not just an estimator error.
For other violations, see `Constant.lasting` and `Physics.lasting`."""


TOUCHING = 1e-9
"""Depth in m up to which bodies touch, but for rounding."""


MISSED = 0.1
"""Share of the frames in which estimators may miss a body; what hides more is left unmeasured."""


class Permanence(PhysicalMetric):
    """Share of the frames in which every object is there exactly once.

    An object may be hidden behind another where the true video had something by then, too, but must
    not vanish, split, double or appear from nowhere. What hardly differs from its surroundings is
    not there.
    """

    name = "permanence"
    definition = 2
    bounds = (0.0, 1.0)
    higher_is_better = True

    def lacking(self, physics: Physics) -> str | None:
        return None if physics.objects else "no objects to track"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """1 for a frame in which every object is there once, else 0, `[T]`."""
        return seen_once(prediction).astype(np.float64)


class LengthError(PhysicalMetric):
    """Relative error of fixed lengths, those of links and ropes.

    They are compared with the lengths in the episode, not with the true video at the same time,
    because they hold for any predicted motion. A length that is not found counts as 0, so its error
    is 1.
    """

    name = "length_error"
    definition = 2
    kind: Literal["length", "amount"] = "length"

    def lacking(self, physics: Physics) -> str | None:
        return None if _of(physics, self.kind) else f"no {self.kind} that is conserved"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The mean over all lengths (or amounts) in each frame, `[T]`; 0.1 is 10 %."""
        constants = _of(physics_of(prediction), self.kind)
        return row_means(np.abs(np.stack([change(each, prediction) for each in constants], 1)))

    def coverage(self, prediction: Prediction, curve: NDArray[np.float64]) -> float:
        """Share of the frames and lengths that are found, of those that the true video shows."""
        constants = _of(physics_of(prediction), self.kind)
        return 1 - float(np.mean([lost(each, prediction) for each in constants]))


class AmountError(LengthError):
    """Relative error of the amount of water or sand.

    In frames without any that is found, though the true video shows some, the error is 1.
    """

    name = "amount_error"
    kind = "amount"


class Penetration(PhysicalMetric):
    """Depth by which solid bodies overlap where they meet, the largest of all pairs.

    They meet in the frames in which they overlap, or almost do: their distance is below what the
    estimator's error can make an overlap. If bodies never meet, nothing is measured. A body that is
    not found stays where it was last seen, so others may run into it; if neither of two is found,
    so may each by its true motion. That a body is not run into counts only if it is found.
    """

    name = "penetration"
    definition = 4
    unit = "m"

    def lacking(self, physics: Physics) -> str | None:
        solid = any(gap.solid is not None for gap in physics.gaps)
        return None if solid else "no two solid bodies whose distance is read"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """The depth in each frame in which bodies meet, `[T]`, in m; 0 where nothing overlaps."""
        gaps = [(gap, gap.solid) for gap in physics_of(prediction).gaps if gap.solid is not None]
        depths = np.stack([_depth(gap, prediction) for gap, _ in gaps], 1)
        meeting = (depths > [-solid for _, solid in gaps]).any(1)
        deepest = np.where(np.isnan(depths), -np.inf, depths).max(1)
        return np.where(meeting, np.maximum(deepest, 0.0), np.nan)

    def coverage(self, prediction: Prediction, curve: NDArray[np.float64]) -> float:
        """Share of the bodies and frames in which a state is found."""
        return share_found(prediction, physics_of(prediction).readings)


def _depth(gap: Gap, prediction: Prediction) -> NDArray[np.float64]:
    """By how much two bodies overlap in each frame, `[T]`; negative is their distance.

    NaN where nothing overlaps and one of them is not found; if that is so in more than `MISSED` of
    the frames, wherever nothing overlaps.
    """
    depth = -measured(gap, prediction, held=True)
    lost = lost_of_pair(prediction, gap.pair)
    if lost.all(1).any():
        start = start_of(prediction)
        either = [-gap.measure(held_among_true(prediction, name), start) for name in gap.pair]
        depth = np.where(lost.all(1), np.fmax(*either), depth)
    unsure = lost.any(1) | (lost.any(1).mean() > MISSED)
    return np.where(unsure & (depth <= TOUCHING), np.nan, depth)


class Violations(PhysicalMetric):
    """Share of the clips that show something impossible.

    It must last for 3 frames in a row, or for longer where the estimator can be wrong for longer.
    Impossible are: an object that is not there exactly once; a length or an amount that changes by
    more than the estimator's error; solid bodies that overlap by more than the estimator's error;
    an object that stays hidden for longer than in any true video. A frame's score is the share of
    clips with a violation in it.
    """

    name = "violations"
    definition = 2
    bounds = (0.0, 1.0)

    def lacking(self, physics: Physics) -> str | None:
        some = (
            physics.objects or physics.constants or any(g.solid is not None for g in physics.gaps)
        )
        return None if some else "nothing that is conserved"

    def per_frame(self, prediction: Prediction) -> NDArray[np.float64]:
        """1 for a frame with a violation, else 0, `[T]`."""
        none = np.zeros(len(prediction.video), np.bool_)
        return np.any([none, *violations(prediction).values()], axis=0).astype(np.float64)

    def value(self, prediction: Prediction) -> float:
        """1 if any frame has a violation, else 0."""
        return float(self.per_frame(prediction).max())


def violations(prediction: Prediction) -> dict[str, NDArray[np.bool_]]:
    """Flags of the frames with a violation, `[T]`, by kind of violation.

    The kinds are ``permanence``, the names of constants, and ``a in b`` for solid bodies. A
    prediction that only repeats the true first frame has no violations, even if the estimator
    misreads that frame.
    """
    physics = physics_of(prediction)
    found: dict[str, NDArray[np.bool_]] = {}
    if repeats_first_frame(prediction):
        return found
    if physics.objects:
        gone = [lasting(unseen, physics.unseen) for unseen in out_of_sight(prediction).T]
        found["permanence"] = np.any(
            [lasting(~seen_once(prediction), physics.lasting), *gone], axis=0
        )
    for constant in physics.constants:
        off = np.abs(change(constant, prediction)) > constant.tolerance
        found[constant.name] = lasting(off, constant.lasting)
    for gap in physics.gaps:
        if gap.solid is not None:
            found[" in ".join(gap.pair)] = lasting(-measured(gap, prediction) > gap.solid)
    return found


def repeats_first_frame(prediction: Prediction) -> bool:
    """Whether the prediction is the true first frame and nothing else."""
    return bool((prediction.video == prediction.target[:1]).all())


def change(constant: Constant, prediction: Prediction) -> NDArray[np.float64]:
    """The relative error of a constant in each frame of the prediction, `[T]`; −1 if it is lost.

    It is relative to the median of the true values, because elastic things stretch a little.
    """
    true = _true(constant, prediction)
    true = true[np.isfinite(true)]
    relative = measured(constant, prediction) / (np.median(true) if len(true) else np.nan) - 1
    return np.where(lost(constant, prediction), -1.0, relative)


def lost(constant: Constant, prediction: Prediction) -> NDArray[np.bool_]:
    """Whether a constant cannot be measured in a frame in which it can be in the truth, `[T]`.

    It must be measurable just before and after, too, because there an estimator may err by one.
    """
    there = np.isfinite(_true(constant, prediction))
    there = np.asarray(ndimage.minimum_filter(there.astype(np.uint8), 3, mode="nearest"), np.bool_)
    gone = np.isnan(measured(constant, prediction))
    return there & (gone | lost_shapes(prediction) if constant.kind == "amount" else gone)


def _true(constant: Constant, prediction: Prediction) -> NDArray[np.float64]:
    return constant.measure(truth_of(prediction), start_of(prediction))


def lasting(flags: NDArray[np.bool_], frames: float = LASTING) -> NDArray[np.bool_]:
    """Keep only the flags in runs of at least `frames`, `[T]`."""
    if len(flags) < frames:
        return np.zeros_like(flags)
    frames = int(frames)
    windows = np.lib.stride_tricks.sliding_window_view(flags, frames)
    runs = np.min(windows, axis=1)
    found = np.zeros_like(flags)
    for shift in range(frames):
        found[shift : shift + len(runs)] |= runs
    return found


def _of(physics: Physics, kind: str) -> list[Constant]:
    return [constant for constant in physics.constants if constant.kind == kind]
