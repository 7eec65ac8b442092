"""What is found in a prediction, and what counts for things that are not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from acwm_core.env.physics import Constant, Gap, Level, Observation, Reading
from acwm_core.evaluation.metric import Prediction
from acwm_metrics.physical import (
    MIN_AREA,
    MIN_SHARE,
    Mask,
    counts,
    ids_of,
    physics_of,
    start_of,
    usual_sizes,
)

FAINT = 0.25
"""Share of its least contrast in the true video below which a thing counts as not seen."""


def seen_of(prediction: Prediction) -> Observation:
    """What is seen in the prediction, without things that hardly differ from what is around them.

    Estimators never saw black, dark or empty frames, and imagine some object in most. Such an
    object is not found: it has no pixels and no states.
    """
    return prediction.once(seen_of, lambda: _without_faint(prediction))


def _without_faint(prediction: Prediction) -> Observation:
    seen, physics = prediction.observed, physics_of(prediction)
    read = [name for reading in physics.readings for name in reading.instances]
    names = [*dict.fromkeys((*physics.objects, *physics.shapes, *read))]
    ids = ids_of(prediction, names)
    faint = np.reshape([_faint(prediction, each) for each in ids], (len(ids), len(seen.masks))).T
    if not faint.any():
        return seen
    masks, states = seen.masks.copy(), dict(seen.states)
    for instance, frames in zip(ids, faint.T, strict=True):
        masks[frames] = np.where(masks[frames] == instance, 0, masks[frames])
    for reading in physics.readings:
        states[reading.field] = values = np.array(states[reading.field], np.float64)
        rows = [names.index(name) for name in reading.instances]
        by_body(values, reading)[faint[:, rows]] = np.nan
    return Observation(masks, states)


def _faint(prediction: Prediction, instance: int) -> Mask:
    """Whether an instance has less than `FAINT` of its least true contrast, `[T]`."""
    pairs = (prediction.target, prediction.masks), (prediction.video, prediction.observed.masks)
    true, seen = (contrast(video.numpy(), masks == instance) for video, masks in pairs)
    least = true[np.isfinite(true)].min(initial=np.inf)
    return seen < FAINT * least if np.isfinite(least) else np.zeros(len(seen), np.bool_)


def contrast(video: NDArray[np.float32], own: Mask) -> NDArray[np.float64]:
    """How much the mean colour of a thing differs from that of its surroundings, `[T]`.

    Args:
        video: `[T, 3, H, W]` in [0, 1].
        own: its pixels, `[T, H, W]`; the score is NaN in frames without any.

    Returns:
        The root mean square over channels.
    """
    if not own.any():
        return np.full(len(own), np.nan)
    ring = np.asarray(ndimage.maximum_filter(own, (1, 5, 5)), np.bool_) & ~own
    inside, around = (mean_colour(video, part) for part in (own, ring))
    return np.sqrt(((inside - around) ** 2).mean(1))


def mean_colour(video: NDArray[np.float32], own: Mask) -> NDArray[np.float64]:
    """The mean colour of pixels `[T, H, W]` of a video `[T, 3, H, W]`, `[T, 3]`; NaN if none."""
    sums = np.einsum("tchw,thw->tc", video, own, dtype=np.float64)
    with np.errstate(invalid="ignore"):
        return sums / own.sum((1, 2))[:, None]


def held_of(prediction: Prediction) -> Observation:
    """What is seen, where bodies that are not found keep the state in which they were last seen.

    A body that the truth does not show either has no state. Before a body is found, its state is
    the true one of the first frame, which every model is given.
    """
    return prediction.once(held_of, lambda: _held(prediction))


def held_among_true(prediction: Prediction, name: str) -> Observation:
    """As `held_of`, but of the bodies that are not found only `name` keeps the state last seen.

    The others have their true states, so that they run into it where they do so in truth.
    """
    return prediction.once((held_among_true, name), lambda: _held(prediction, name))


def _held(prediction: Prediction, name: str | None = None) -> Observation:
    seen = seen_of(prediction)
    states = dict(seen.states)
    for reading in physics_of(prediction).readings:
        fill = lost_bodies(prediction, reading)
        if fill.any():
            true = by_body(np.array(prediction.states[reading.field], np.float64), reading)
            states[reading.field] = values = np.array(states[reading.field], np.float64)
            bodies, missing = by_body(values, reading), ~found(seen, reading)
            last = last_seen(bodies, missing, true[0])
            held = [name in (None, each) for each in reading.instances]
            bodies[fill] = np.where(np.array(held)[:, None], last, true)[fill]
    return Observation(seen.masks, states)


def lost_bodies(prediction: Prediction, reading: Reading) -> Mask:
    """Whether each body of a reading is not found though the true video shows it, `[T, n]`.

    What vanished in sight is lost until it is found again.
    """
    key = (lost_bodies, reading.field, tuple(reading.instances))
    return prediction.once(key, lambda: _lost(prediction, reading))


def _lost(prediction: Prediction, reading: Reading) -> Mask:
    missing = ~found(seen_of(prediction), reading)
    lost = missing & shown(prediction, reading.instances)
    for frame in range(1, len(lost)):
        lost[frame] |= missing[frame] & lost[frame - 1]
    return lost


def lost_of_pair(prediction: Prediction, pair: Sequence[str]) -> Mask:
    """Whether each of two bodies is lost, see `lost_bodies`, `[T, 2]`."""
    lost = {name: np.zeros(len(prediction.masks), np.bool_) for name in pair}
    for reading in physics_of(prediction).readings:
        for name, each in zip(reading.instances, lost_bodies(prediction, reading).T, strict=True):
            if name in lost:
                lost[name] |= each
    return np.stack([lost[name] for name in pair], 1)


def last_seen(
    values: NDArray[np.float64], missing: Mask, start: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The last values that were not missing; `start` before there are any.

    Args:
        values: `[T, n, …]`.
        missing: `[T, n]`.
        start: `[n, …]`.
    """
    frame = np.where(missing, -1, np.arange(len(values))[:, None])
    last = np.maximum.accumulate(frame, axis=0)
    every = np.concatenate([start[None], values])
    return every[last + 1, np.arange(values.shape[1])]


def by_body(values: NDArray[np.float64], reading: Reading) -> NDArray[np.float64]:
    """A view `[T, n, …]` of a state field with one row per body."""
    return values.reshape(len(values), len(reading.instances), -1)


def found(seen: Observation, reading: Reading) -> Mask:
    """Whether each body of a reading has a state, `[T, n]`."""
    states = by_body(np.asarray(seen.states[reading.field], np.float64), reading)
    return np.logical_and.reduce(np.isfinite(states), axis=-1)


def shown(prediction: Prediction, names: Sequence[str]) -> Mask:
    """Whether the true video shows each instance, also just before and after, `[T, n]`.

    The frames beside those that hide it are left out, because there an estimator may err by one. A
    lone frame shows nothing: in no frame before it could a thing have been seen last.
    """
    return prediction.once((shown, tuple(names)), lambda: _shown(prediction, names))


def _shown(prediction: Prediction, names: Sequence[str]) -> Mask:
    areas = counts(prediction.masks, ids_of(prediction, names))
    least = np.maximum(MIN_SHARE * usual_sizes(areas), MIN_AREA * prediction.masks[0].size)
    there = ((areas >= least) & (len(areas) > 1)).astype(np.uint8)
    return np.asarray(ndimage.minimum_filter(there, (3, 1), mode="nearest"), np.bool_)


def lost_shapes(prediction: Prediction) -> Mask:
    """Whether sand, water, … is not found in a frame of which the truth shows it, `[T]`."""
    names = physics_of(prediction).shapes
    ids = ids_of(prediction, names)
    true, seen = counts(prediction.masks, ids), counts(seen_of(prediction).masks, ids)
    missing = shown(prediction, names) & (seen < MIN_SHARE * true)
    return np.logical_or.reduce(missing, axis=1)


def share_found(prediction: Prediction, readings: Sequence[Reading]) -> float:
    """Share of the bodies and frames in which a state is found, of those that have a score."""
    right = total = 0
    for reading in readings:
        there = found(seen_of(prediction), reading)
        counted = (there | shown(prediction, reading.instances)) & exist(prediction, reading)
        right, total = right + (there & counted).sum(), total + counted.sum()
    return float(right / total) if total else float("nan")


def exist(prediction: Prediction, reading: Reading) -> Mask:
    """Whether the episode has each body of a reading, `[T, n]`."""
    if not reading.present:
        return np.ones((len(prediction.masks), len(reading.instances)), np.bool_)
    there = np.asarray(prediction.states[reading.present]) > 0
    return there.reshape(len(there), -1)


def measured(
    quantity: Constant | Gap | Level, prediction: Prediction, *, held: bool = False
) -> NDArray[np.float64]:
    """A quantity in each frame of the prediction, see `Measure`; with `held_of` states if held."""
    seen = held_of if held else seen_of
    key = (seen, quantity.measure)
    return prediction.once(key, lambda: quantity.measure(seen(prediction), start_of(prediction)))
