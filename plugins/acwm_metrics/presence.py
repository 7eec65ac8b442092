"""Checks whether every object is in a video exactly once."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from acwm_core.evaluation.metric import Prediction
from acwm_metrics.physical import MIN_SHARE, Mask, counts, ids_of, physics_of, usual_sizes
from acwm_metrics.seen import seen_of

COVERED = 0.3
"""Share of an object's last seen area that others must cover for it to count as hidden."""

MOSTLY = 0.5
"""Only objects last seen with less than this share of their area can be carried out of sight."""

_NEIGHBOURS = np.ones((3, 3), np.int64)
_IN_FRAME = np.stack([0 * _NEIGHBOURS, _NEIGHBOURS, 0 * _NEIGHBOURS])


def seen_once(prediction: Prediction) -> Mask:
    """Whether every object is there once in each frame, `[T]`."""
    return prediction.once(
        seen_once, lambda: np.logical_and.reduce(list(presence(prediction).values()))
    )


def presence(prediction: Prediction) -> dict[str, Mask]:
    """Whether each object is correctly present or absent in each frame, `[T]`, by name.

    An object of the episode must be seen in one piece, unless something is in front of it or it
    extends beyond the frame. What is in front of it must also be there in the true video. An object
    that the episode does not have must not be seen.
    """
    physics, masks = physics_of(prediction), seen_of(prediction).masks
    ids, areas, sizes = _areas(prediction)
    before, exist, least = _in_front(prediction), sizes > 0, _least(sizes)
    movable = {name for reading in physics.readings for name in reading.instances}
    found: dict[str, Mask] = {}
    for k, (name, instance) in enumerate(zip(physics.objects, ids, strict=True)):
        seen = areas[:, k] >= least[k]
        if exist[k]:
            others = before[before != instance]
            found[name] = seen | hidden(masks, prediction.masks, int(instance), seen, others)
            if name in movable:
                much = MOSTLY * float(sizes[k])
                gone = counts(prediction.masks, ids[k : k + 1])[:, 0] < least[k]
                gone = np.logical_or.accumulate(gone)  # by then; a prediction may be late
                found[name] |= gone & carried(masks, int(instance), seen, others, much)
            found[name] &= pieces(masks, int(instance), others, float(least[k])) <= 1
        else:
            found[name] = ~seen
    return found


def parts_of(prediction: Prediction, masks: NDArray[np.uint8]) -> NDArray[np.int64]:
    """The number of parts in which masks `[T, H, W]` show each object, `[T, objects]`."""
    ids, _, sizes = _areas(prediction)
    before = _in_front(prediction)
    parts = [
        pieces(masks, int(each), before[before != each], float(least))
        for each, least in zip(ids, _least(sizes), strict=True)
    ]
    return np.stack(parts, 1)


def _in_front(prediction: Prediction) -> NDArray[np.int64]:
    """The ids of all that can be in front of something."""
    physics = physics_of(prediction)
    return ids_of(prediction, [*physics.objects, *physics.shapes])


def _least(sizes: NDArray[np.float64]) -> NDArray[np.float64]:
    """The area from which on an object is seen, `[n]`, from usual ones; 0 for those not there."""
    exist = sizes > 0
    return MIN_SHARE * np.where(exist, sizes, np.median(sizes[exist]) if exist.any() else np.inf)


def out_of_sight(prediction: Prediction) -> Mask:
    """Whether each object of the episode is not seen, hidden or missing, `[T, objects]`."""
    _, areas, sizes = _areas(prediction)
    return (areas < MIN_SHARE * sizes) & (sizes > 0)


def _areas(
    prediction: Prediction,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Ids `[n]` of all objects, their areas in the prediction `[T, n]`, and usual areas `[n]`."""
    ids = ids_of(prediction, physics_of(prediction).objects)

    def areas() -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        seen, true = (counts(each, ids) for each in (seen_of(prediction).masks, prediction.masks))
        return ids, seen, usual_sizes(true)

    return prediction.once(_areas, areas)


def hidden(
    masks: NDArray[np.uint8],
    true: NDArray[np.uint8],
    instance: int,
    seen: Mask,
    others: NDArray[np.int64],
) -> Mask:
    """Whether something is in front of an object that is not seen, `[T]`.

    This is the case if it lies where the object was last seen, or next to the object's visible
    rest. The true video must have had something there by then, too: nothing is hidden by what was
    made up.

    Args:
        masks: instance ids, `[T, H, W]`.
        true: those of the true video.
        instance: id of the object.
        seen: whether enough of it is seen, `[T]`.
        others: ids of all that may be in front of it.
    """
    found, last = np.zeros(len(masks), np.bool_), true[0] == instance
    lawful = np.logical_or.accumulate(np.isin(true, others))
    for frame in np.flatnonzero(~seen):
        earlier = np.flatnonzero(seen[:frame])
        if len(earlier):
            last = masks[earlier[-1]] == instance
        cover = np.isin(masks[frame], others) & lawful[frame]
        left = np.asarray(ndimage.maximum_filter(masks[frame] == instance, 3), np.bool_)
        found[frame] = (cover & left).any() or cover[last].sum() >= COVERED * last.sum()
    return found


def carried(
    masks: NDArray[np.uint8], instance: int, seen: Mask, others: NDArray[np.int64], much: float
) -> Mask:
    """Whether an object that is not seen may be moving behind what almost hid it, `[T]`.

    An example is a cube in a hand. Less than `much` pixels of the object were last seen, next to
    something that is still there. An object that vanishes in full sight is not carried.
    """
    found = np.zeros(len(masks), np.bool_)
    for frame in np.flatnonzero(~seen):
        earlier = np.flatnonzero(seen[:frame])
        if not len(earlier):
            continue
        last = masks[earlier[-1]]
        own = last == instance
        if own.sum() < much:
            beside = np.asarray(ndimage.maximum_filter(own, 3), np.bool_) & ~own
            found[frame] = np.isin(masks[frame], np.intersect1d(last[beside], others)).any()
    return found


def pieces(
    masks: NDArray[np.uint8], instance: int, others: NDArray[np.int64], least: float
) -> NDArray[np.int64]:
    """The number of parts in which an object is seen in each frame, `[T]`.

    Only parts of at least `least` pixels count. They count as one if only things that may be in
    front of the object lie between them, or if they can meet beyond the border of the frame.
    """
    number = np.zeros(len(masks), np.int64)
    own = masks == instance
    if not own.any():
        return number
    box = _box(own.any(0))
    parts = connected(own[:, *box])
    sizes = np.bincount(parts.ravel())
    where = np.flatnonzero((sizes >= least) & (np.arange(len(sizes)) > 0))
    frame_of = np.zeros(len(sizes), np.int64)
    frame_of[parts.reshape(len(parts), -1)] = np.arange(len(parts))[:, None]
    np.add.at(number, frame_of[where], 1)
    for frame in np.flatnonzero(number > 1):
        cover = np.isin(masks[frame], np.append(others, instance))
        joined = connected(np.pad(cover, 1, constant_values=True)[None])[0, 1:-1, 1:-1]
        number[frame] = len(np.unique(joined[box][np.isin(parts[frame], where)]))
    return number


def _box(mask: Mask) -> tuple[slice, slice]:
    """The bounding box of a mask `[H, W]`."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def connected(mask: Mask) -> NDArray[np.int64]:
    """Number the connected regions of every frame from 1, `[T, H, W]`; 0 outside of them.

    Pixels at most two apart are connected, because thin things have gaps in small frames.
    """
    numbers, _ = cast(Any, ndimage.label(ndimage.maximum_filter(mask, (1, 3, 3)), _IN_FRAME))
    return numbers * mask
